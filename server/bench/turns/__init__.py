"""Two commits compared in one run, by turns: a warm query, import, start and saturation.

Times of two runs differ by more than a change of the code does, so both commits are measured in one, in the order
A B B A. What is compared first is processor time, which other programs on the machine change least. Ratios are
geometric means with 95 % intervals by bootstrap: over the photographs for a warm query, over the turns elsewhere.
Begin with `command`.
"""
