"""Acceptance of a pose.

`gate` rejects poses that chance could support; `judge` computes a trust from the evidence (`evidence`, and the
`agreement` of halves of the data), and rejects by it, by `ambiguity` (a second pose explains the photograph) and by
`focal` (the photograph contradicts its focal length). `two_view` accepts poses that rest on matches with references.
"""
