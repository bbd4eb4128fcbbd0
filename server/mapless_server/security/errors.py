"""What can be wrong with the files of tokens and certificates."""

from __future__ import annotations


class SecurityError(Exception):
    """A file cannot be used, or a token not be made; the message is one sentence for the operator."""
