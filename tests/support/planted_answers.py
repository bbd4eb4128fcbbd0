"""Answers of a planted scene, as a server would give them."""

from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from mapless.answers import Accuracy, Hint, LocalizationResult, PriorCheck, Rejected
from mapless.diagnostics import Debug, Diagnostics, ReferenceUse
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import RadialTangential

CAMERA = Camera(640, 480, 500.0, 505.0, 321.0, 238.0, RadialTangential(-0.1, 0.02, 0.001, 0.0, 0.0))
NOW = datetime(2026, 11, 21, 12, 0, 0, tzinfo=timezone.utc)


def truth() -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.2, -0.1, 0.3]), np.array([1.0, 2.0, 3.0]))


def debug(noise_px: float = 1.0, wrong: int = 20) -> Debug:
    """Two hundred points of a planted scene, as the photograph and two references show them."""
    random = np.random.default_rng(5)
    x = truth().apply(random.uniform((-2, -1.5, 4), (2, 1.5, 8), (200, 3)))
    pixels = CAMERA.project(truth().inverse().apply(x)) + random.normal(0, noise_px, (200, 2))
    is_inlier = np.arange(200) >= wrong
    pixels[~is_inlier] = random.uniform(0, 480, (wrong, 2))
    shown = random.uniform(0, 480, (200, 2))
    source = np.where(np.arange(200) < 150, "TRIANGULATED", "MEASURED_DEPTH")
    return Debug(pixels, x, is_inlier, np.where(is_inlier, 0.8, 30.0), np.arange(200) % 2, shown, source)


def diagnostics(names: tuple[str, ...] = ("a", "b")) -> Diagnostics:
    uses = tuple(ReferenceUse(f"scenes/hall/references/{name}", 90 - i, 70 - i, 0.4) for i, name in enumerate(names))
    return Diagnostics("id-1", "geometric", "", "sift", "BEST", 3, uses, None, {"pnp": 0.02}, 0, 0.3, 640, 480, "0.1.0")


def localized(**changes: object) -> LocalizationResult:
    answer = LocalizationResult(
        truth(),
        np.diag([4e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6]),
        Accuracy(0.02, 0.04, 0.1, 0.2, False),
        "REFINED",
        180,
        200,
        0.8,
        diagnostics(),
        capture_time=NOW,
        trust=0.4,
        prior_checks=(PriorCheck("GRAVITY", 0.7, 2, False, True), PriorCheck("POSITION", 8.0, 3, True, False)),
        debug=debug(),
    )
    return replace(answer, **changes)  # type: ignore[arg-type]


def rejected(**changes: object) -> Rejected:
    hint = Hint("pnp", "LOOK_AT_REFERENCE", "Point the camera there.", "scenes/hall/references/a")
    return replace(Rejected("LOW_OVERLAP", "only 3 matches", diagnostics(), hint=hint), **changes)  # type: ignore[arg-type]
