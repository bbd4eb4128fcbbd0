"""Programs that measure this repository's server: accuracy, latency, load, networks, retrieval, replicas.

They are not installed. `make bench`, `bench-turns`, `bench-gpu`, `bench-retrieval`, `load` and `load-ray` run them, and
so does, in the repository's root, `PYTHONPATH=client:server python -m bench.NAME`. They import the tools, which do not
import them.
"""
