"""What can be wrong with a folder of captured calls."""

from __future__ import annotations


class CaptureError(Exception):
    """The folder, or a call in it, cannot be used; the message is one sentence for the operator."""


class DamagedCapture(CaptureError):
    """What is kept of a call is not what was written: cut, changed, or a part of it is gone."""


class BlobGone(Exception):
    """A blob that the folder had when it was asked has been deleted since."""
