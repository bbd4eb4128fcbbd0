"""Whether a pose is to be believed.

`gate` rejects what chance could do; `judge` weighs the `evidence` into a trust, with `ambiguity` (a second place)
and `focal` (a focal length that the photograph contradicts).
"""
