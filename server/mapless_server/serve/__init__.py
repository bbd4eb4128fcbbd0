"""The process: from settings to a running server, and its end.

May import every room of the package. Begin with `run.serve`, which runs until a signal, then `running.running_server`,
which opens in order what must be closed in reverse; `listening` receives the calls, `assembly` makes engine and store
from the settings, `command` is the command line, and `adoption` has answered photographs become references. Modules are
imported one by one, since `libraries` must be applied before the others are imported.
"""
