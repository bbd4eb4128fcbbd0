"""Reports of a scene: what is counted of answered photographs, and where further references would help.

Begin with `counting` (photographs become counts by day, place and outcome), then `summary` (counts become a report)
and `renewal` (what was counted before references were added).
"""
