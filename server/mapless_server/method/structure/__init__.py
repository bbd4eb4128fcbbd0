"""Structure: metric points, triangulated from the references by their poses, and the query's 2D-3D matches with them.

Begin with `structure.build_structure`, then `match`. `observations` has the equations of points, `model` the data,
`kept_depth` points from depths of the references, `measured_depth` those of sensors.
"""
