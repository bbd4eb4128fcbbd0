"""Entry point of the command `mapless`, outside the package, so that Ctrl-C during its import is quiet, too."""

import os
import signal

EXIT_INTERRUPTED = 130  # as in shells


def main() -> None:
    """Run the command line; exits."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else the parent process wants it ignored
        # Not an exception, which a partly imported module may convert to another. Nothing needs cleaning up yet.
        signal.signal(signal.SIGINT, lambda *_: os._exit(EXIT_INTERRUPTED))
    # Read at import. Failed connections are reported by our errors, so gRPC's own log is not needed.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    from mapless.__main__ import main as run

    signal.signal(signal.SIGINT, before)
    run()
