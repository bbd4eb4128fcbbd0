"""Pose estimators: from matches to a pose with its inliers.

`pnp` takes 2D-3D matches, `with_priors` a pose prior as well; `relative` and `two_view` take matches with posed
references, without points (`two_view_matches`); `by_depths` a network's depths; `generalized` the matches of
several cameras.
"""
