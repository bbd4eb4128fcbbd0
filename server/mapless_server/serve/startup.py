"""Why a server cannot start, for its operator."""

from mapless_server.extras import install_hint


class StartupError(Exception):
    """The server cannot start; the message is one sentence for the operator."""


def what_is_missing(error: Exception) -> str:
    """The error for the operator; of a package that is missing, how to get it."""
    return install_hint(error) if isinstance(error, ImportError) else str(error)
