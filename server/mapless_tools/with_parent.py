"""`python -m mapless_tools.with_parent MODULE ARGUMENT...`: runs a module that ends with the process that started it.

Standard input is a pipe that this process alone keeps open. However it ends, also killed, the pipe ends with it.
"""

import os
import runpy
import signal
import sys
import threading


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
