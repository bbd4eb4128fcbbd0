"""The process: from settings to a server that listens, and its end.

May import every room of the package. Begin with `run.serve`, then `running.running_server`, which holds in order what
must be closed in reverse; `assembly` makes the engine from the settings.
"""
