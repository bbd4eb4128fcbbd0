"""The numbers that a plan is made of, each with its origin: measured, counted, or predicted and never measured.

All are of BENCHMARKS.md; the section is named with each.
"""

from __future__ import annotations

CPU_S_PER_QUERY = 0.72
"""Measured ("Under load"): processor seconds of an answer, the rendered room, SIFT, 10 references, AMD EPYC."""

CPU_SPREAD = 0.16
"""Measured (the same): standard deviation of the logarithm of a call's time, from p99 / p50 = 740 / 513 ms unloaded."""

SERVING_CPU_S = 0.00276
"""Measured (the same): processor seconds of all of the server but the method, a call of 0.3 MB."""

GPU_S_PER_QUERY = 0.072
"""Predicted ("Networks"), never measured: pi3, compiled, 11 views, the references' tokens in memory; an H200."""

GPU_S_PER_MISSED_REFERENCE = 0.0019
"""Predicted, never measured: what a reference costs whose tokens are not: (91 - 72) ms / 10."""

TOKEN_BYTES = 2.1e6
"""Counted ("Networks"): tokens of a reference in bfloat16."""

TOKEN_MEMORY_BYTES = 100e9
"""Assumed: of an H200's 141 GB, what is left for tokens beside weights (1.93 GB, counted) and computing."""

FEATURE_BYTES = 2048 * (2 + 128 + 1) * 4
"""Counted: 2048 SIFT features in memory, float32: place, descriptor, score."""

PHOTO_BYTES = 0.3e6
"""Assumed: a reference's photograph, as in the measurements of serving."""

RANKING_MS = ((1e3, 0.75), (1e4, 3.1), (1e5, 32.0), (1e6, 265.0))
"""Measured ("References at fleet scale"): (references, milliseconds of one thread to rank them)."""

INDEX_BYTES = ((1e3, 1370.0), (1e4, 1359.0), (1e5, 1407.0), (1e6, 1550.0))
"""Measured (the same): (references, bytes each in the retrieval index)."""

DATABASE_LOAD_MS = 6.5
"""Measured (the same): 10 references by name from PostgreSQL, p50, with small synthetic features."""

REFERENCES_PER_QUERY = 10
"""The default of `Localize`, and of all measurements above."""
