"""Names of backends and of local features, as a setting gives them.

Imports nothing, so that settings are checked, and shown by --help, before anything that computes is loaded.
"""

EDGEPOINT2 = ("edgepoint2-s64", "edgepoint2-m64", "edgepoint2-l64", "edgepoint2-e64")
"""The variants of EdgePoint2, the cheapest first."""

FEATURES = ("sift", *EDGEPOINT2, "aliked", "xfeat", "superpoint")
"""Kinds of local features; all but the first need weights of the same name. `features.make_extractor` makes them."""

NETWORKS = ("pi3", "pi3x", "mapanything")
"""Backends with a network, which need weights of the same name; those of pi3 and pi3x are licensed for non-commercial
use. `auto` looks for them in this order: the paper's method and figures are pi^3's, and it is the smallest one.
`coarse.make` makes them."""

BACKENDS = ("geometric", *NETWORKS)

OFF, STORED = "off", "stored"
"""Settings of the depth kept with references: none is made or used; that is used which other servers make."""

AUTO = "auto"
"""The setting that chooses by device and weights."""

BEST_VARIANTS = {"edgepoint2": "edgepoint2-l64"}
"""Settings of features for the variant that measures best."""
