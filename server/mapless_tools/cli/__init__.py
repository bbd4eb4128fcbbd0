"""Commands of packages that are too heavy to import before it is known what is wanted; `cli` has them all."""
