"""Pairs of photographs: matches among references and of the query with them, and whether poses agree with them.

Begin with `correspond`. `epipolar` has the geometry of two views with poses, `pair` the order and the cached matches of
a pair, `agreement` whether two references agree with their poses, `stationary` what is fixed to the camera, `fixed`
matches without it, `readings` which mistake in poses or intrinsics explains pairs that do not agree; `make` makes the
matcher of a kind of features.
"""
