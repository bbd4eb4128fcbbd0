"""Measuring the server on photographs with known poses.

One folder of one's own (`command`): plan (who is a reference, who a query, which references a query gets) > run (a
server of its own, one call a query) > metrics > report.

Benchmarks as in the paper (`benchmark_command`): benchmarks (scenes on the disk) > protocol (settings and methods) >
suite (each run, kept in a journal) > averages > tables, charts, pictures > figures (JSON, CSV), page (HTML).
"""
