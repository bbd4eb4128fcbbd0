"""Generated from proto/mapless/v1 by `make proto`; not edited by hand."""
