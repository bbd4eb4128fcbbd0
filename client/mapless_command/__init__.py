"""Where the command `mapless` begins: outside the package, so that Ctrl-C while that is loaded is quiet, too."""

from __future__ import annotations

import os
import signal

EXIT_INTERRUPTED = 130  # as shells have it


def main() -> None:
    """Run the command line; exits."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else who started us wants it ignored
        # Not an exception: modules that are half loaded turn it into others. Nothing has to be put in order yet.
        signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_INTERRUPTED))
    # Read when it is loaded; what it logs of a failed connection, the error says, and in words.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from mapless.__main__ import main as run

    signal.signal(signal.SIGINT, before)
    run()
