"""The load generator: what the server answers, refuses and costs when more or less is asked of it."""
