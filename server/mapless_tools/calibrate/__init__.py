"""Whether answers keep what they claim: measured on photographs with known poses, and put right by factors.

A folder's photographs are localized (`queries`); each error beside the radii that were claimed is a `Claim`; from these
come the reliability diagram and the factors (`fit`), which a scene keeps and every answer is multiplied by (`factors`).
"""
