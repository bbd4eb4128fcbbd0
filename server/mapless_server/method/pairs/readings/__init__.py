"""Data that were read otherwise than they were meant: whether photographs fit their poses, and why not if not.

Begin with `verdict.judge`: from posed views and the matches of pairs to a verdict, with the median error, the share of
bad pairs, and the likely mistake. `errors` has the measure; `conventions`, `intrinsics` and `rounding` the mistakes
with their corrections; `explanation` finds the one that makes the pairs fit. `repeats` finds poses and photographs that
are given several times, `sessions` photographs in two worlds, `alignment` the similarity between these, `depth` whether
the unit is plausible.
"""
