"""Depth that is kept with references: predicted by a network once, in the background, and checked.

Begin with `check` (what is kept of a prediction), then `maker` (one reference and its neighbours) and `scene_depths`
(the references that wait). `finder` is what queries find; `method.kept_depth` uses it. They are in `store.depths`.
"""
