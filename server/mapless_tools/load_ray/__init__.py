"""The adapter tried for real on one machine: a Ray cluster of its own, for tests and measurements.

`python -m mapless_tools.load_ray` measures; `cluster` is what starts and ends the cluster.
"""
