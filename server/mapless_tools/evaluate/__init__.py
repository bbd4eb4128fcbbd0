"""Accuracy and latency on photographs with known poses, measured through a server of its own.

A folder (`command.evaluate_folder`): plan (references and queries) > references (those of each query) > run (one call
a query) > metrics > report.

Benchmarks as in the paper (`command.evaluate_benchmarks`): benchmarks (scenes on the disk) > plan (settings, methods) >
suite (each run, kept in a journal) > tables, pictures > figures (JSON, CSV), page (HTML).

Other tools may import `plan`, `references`, `run` and `metrics`. Begin reading with `run`.
"""
