"""How a command ends that cannot do its work: one line on standard error, and an exit code by the cause.

Imports nothing that is slow.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from mapless_server.serve.command import fail


class UsageError(ValueError):
    """Arguments, settings or a folder are wrong, or do not fit together; the message is for a person."""


@contextmanager
def usage_errors() -> Iterator[None]:
    """Converts ValueError and ConfigError to UsageError, in a block that only checks arguments."""
    from mapless_server.settings import ConfigError

    try:
        yield
    except (ValueError, ConfigError) as error:
        raise UsageError(str(error)) from error


@contextmanager
def failures_end_command(
    usage: type[ValueError] = UsageError, interrupted: str = "interrupted", failure: type[Exception] = OSError
) -> Iterator[None]:
    """Ends the command after a failure: exit code 2 for wrong usage or a missing package, 130 after Ctrl-C.

    1 for a server, a file, or another `failure`.
    """
    from mapless import MaplessError
    from mapless_server.extras import install_hint
    from mapless_server.settings import ConfigError
    from mapless_tools.child import ServerFailed

    try:
        yield
    except ImportError as error:
        fail(install_hint(error))
    except (usage, ConfigError) as error:
        fail(str(error))
    except (ServerFailed, MaplessError, OSError, failure) as error:
        fail(str(error), code=1)
    except KeyboardInterrupt:
        fail(interrupted, code=128 + signal.SIGINT)
