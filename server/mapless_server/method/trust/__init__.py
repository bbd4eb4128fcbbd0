"""Whether a pose is to be believed, and what to do if not.

`gate` turns down what chance could do; `judge` weighs the `evidence` into a trust, with `ambiguity` (a second place)
and `focal` (a focal length that the photograph contradicts); `hints` says what would help.
"""
