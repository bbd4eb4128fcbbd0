"""Measuring the server on photographs with known poses.

plan (who is a reference, who a query, which references a query gets) > run (a server of its own, one call a query) >
metrics > report.
"""
