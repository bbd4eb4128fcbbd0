"""Depths stored with references: predicted by a network once, in the background, and checked.

Begin with `check` (what is kept of a prediction), then `scene_depths` (one reference and its neighbours, and the
references that wait). Queries find depths by `stored.DepthFinder`, and use them in `method.structure.kept_depth`;
`store.depths` has them.
"""
