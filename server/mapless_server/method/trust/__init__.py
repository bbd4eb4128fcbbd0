"""Acceptance of a pose.

`gate` rejects poses that chance could support; `judge` computes a trust from the evidence (`evidence`), and rejects by
it, where a second pose explains the photograph, and by `intrinsics` (the photograph contradicts its own). `two_view`
accepts poses that rest on matches with references.
"""
