"""Measures how often the truth is within the claimed radii, on photographs with known poses, and finds factors.

A folder's photographs are localized (`queries`); a `Claim` is an error with the radii that were claimed for it. Claims
give the factors (`claims`), which the server stores with a scene and multiplies its radii by, and the report
(`findings`, `report`). Begin reading with `run`.
"""
