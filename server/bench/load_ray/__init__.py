"""Replicas on Ray Serve, measured on this machine: `python -m bench.load_ray`.

Begin with `__main__`, which has the four measurements, and `cluster`, which starts and ends a Ray cluster of its own.
"""
