"""How an operator sees the server: metrics and their port, the log, traces. Nothing here decides anything."""
