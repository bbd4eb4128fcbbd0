"""Measures the server under load: overhead, latency and goodput up to three times its capacity, and a soak.

`overhead`, `pipeline` and `soak` are the three measurements; each is made of steps (`step`, `driving`), in which calls
planned beforehand (`calls`) are sent (`sender`) and counted, while the server is watched from outside (`watch`). Begin
reading with `pipeline`. Ray Serve's replicas are measured by `load_ray` with the same parts.
"""
