"""The error of files of tokens and certificates."""

from __future__ import annotations


class SecurityError(Exception):
    """A file cannot be used, or a token cannot be created; the message is one sentence for the operator."""
