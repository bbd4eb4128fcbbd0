"""How often answers keep the radii that they claim, measured on photographs with known poses, and factors that help.

A folder's photographs are localized (`queries`); each error beside the radii that were claimed is a `Claim`; from these
come the factors (`claims`), which a scene keeps and the server multiplies every answer by, and what the report says
(`findings`, `report`). Begin reading with `run`.
"""
