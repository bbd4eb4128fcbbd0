"""Motion during the read-out of a rolling shutter: how radii and errors depend on the prior of the motion.

Two places of the rendered room, each with the twelve motions of `rendered_room.rolling`, are localized against the
demo's references in this process, with SIFT: without a read-out time, and with it by other priors.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle import readout, shutter
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.bundle.readout import RollingShutter
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.views import PosedView, View, reduce_image
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pipeline import Pipeline
from mapless_tools.demo.photographs import room
from mapless_tools.evaluate.metrics import pose_error

from ..rendered_room.furniture import lit_room
from ..rendered_room.photographs import Station, scatter
from ..rendered_room.rolling import CAMERA, MOTIONS, STILL, rolled
from .page import Measurement, Row

READOUT_S, FIRST, PLACES = 0.033, 8, 2
SHARPER = 0.36
"""By which radii of this room are smaller when its references have calibrated them."""
PRIORS: dict[str, tuple[Sequence[float], Sequence[float], float]] = {
    "0, 1/4, 1 of 90 degrees/s; 60 % still": ((1e-3, 0.25, 1.0), (0.6, 0.2, 0.2), 90.0),
    "a third still": ((1e-3, 0.25, 1.0), (0.34, 0.33, 0.33), 90.0),
    "80 % still": ((1e-3, 0.25, 1.0), (0.8, 0.1, 0.1), 90.0),
    "of 45 degrees/s": ((1e-3, 0.25, 1.0), (0.6, 0.2, 0.2), 45.0),
    "1/8 instead of 1/4": ((1e-3, 0.125, 1.0), (0.6, 0.2, 0.2), 90.0),
    "no slow ones": ((1e-3, 0.25, 1.0), (0.6, 1e-9, 0.4), 90.0),
}


@dataclass(frozen=True)
class Found:
    """An answer: its errors and radii of 95 %, metres and degrees."""

    metres: float
    degrees: float
    radius_m: float
    radius_deg: float

    @property
    def is_inside(self) -> bool:
        """Whether both errors are inside the radii as they are when calibrated."""
        return self.metres <= SHARPER * self.radius_m and self.degrees <= SHARPER * self.radius_deg


def rows(_: Path) -> Iterator[Row]:
    """A row without a read-out time, and one for each prior."""
    references, photos = _references(), list(_photographs())
    is_still = [motion is STILL for _, _, motion in photos]
    without = _answers(references, photos, LocalizeOptions())
    yield _row("no read-out time", without, without, is_still)
    for title, prior in PRIORS.items():
        with _prior(*prior):
            options = LocalizeOptions(shutter=RollingShutter(READOUT_S))
            yield _row(title, without, _answers(references, photos, options), is_still)


@contextmanager
def _prior(scales: Sequence[float], shares: Sequence[float], turn_deg_per_s: float) -> Iterator[None]:
    before = shutter.SCALES, shutter.SHARES, readout.USUAL_TURN_DEG_PER_S
    shutter.SCALES, shutter.SHARES, readout.USUAL_TURN_DEG_PER_S = tuple(scales), tuple(shares), turn_deg_per_s
    try:
        yield
    finally:
        shutter.SCALES, shutter.SHARES, readout.USUAL_TURN_DEG_PER_S = before


def _references() -> tuple[PosedView, ...]:
    extractor, found = make_extractor("sift"), list[PosedView]()
    for it in room().references:
        image, camera = reduce_image(decode_image(it.data, ImageLimits()), it.camera, CAMERA.width_px)
        view = extractor.extract(image, camera)
        found.append(PosedView(it.name, f"scenes/room/references/{it.name}", view, it.world_from_camera))
    return tuple(found)


def _photographs() -> Iterator[tuple[View, RigidTransform, object]]:
    """Views with the pose in the middle of the read-out, and the motion."""
    lit, extractor = lit_room(0), make_extractor("sift")
    for place in scatter(0, FIRST + PLACES, lit)[FIRST:]:
        for name, motion in MOTIONS.items():
            station = Station(f"{place.name}-{name}", CAMERA, place.world_from_camera)
            view = extractor.extract(rolled(lit, station, motion, READOUT_S), CAMERA)
            yield view, place.world_from_camera, motion


def _answers(
    references: tuple[PosedView, ...], photos: Sequence[tuple[View, RigidTransform, object]], options: LocalizeOptions
) -> list[Found | None]:
    pipeline, found = Pipeline(make_reconstructor("geometric", Path()), make_matcher("sift", 1)), list[Found | None]()
    for view, pose, _ in photos:
        outcome = localize(view, references, pipeline, options).outcome
        if not isinstance(outcome, Localization) or outcome.covariance is None:
            found.append(None)
            continue
        accuracy = accuracy_from_covariance(outcome.covariance)
        errors = pose_error(pose, outcome.world_from_camera)
        found.append(Found(*errors, accuracy.position_95_m, accuracy.rotation_95_deg))
    pipeline.matcher.close()
    return found


def _row(title: str, without: Sequence[Found | None], found: Sequence[Found | None], is_still: Sequence[bool]) -> Row:
    moving = [it for it, still in zip(found, is_still, strict=True) if it and not still]
    pairs = [(a, b) for a, b, still in zip(without, found, is_still, strict=True) if a and b and still]
    ratios = [it for a, b in pairs for it in (b.radius_m / a.radius_m, b.radius_deg / a.radius_deg)]
    return {
        "prior": title,
        "localized": f"{sum(it is not None for it in found)} of {len(found)}",
        "moving: median error": f"{100 * np.median([it.metres for it in moving]):.2f} cm, "
        f"{np.median([it.degrees for it in moving]):.2f} deg",
        "inside calibrated 95 % radii": f"{sum(it.is_inside for it in moving)} of {len(moving)}",
        "their median": f"{100 * SHARPER * np.median([it.radius_m for it in moving]):.2f} cm, "
        f"{SHARPER * np.median([it.radius_deg for it in moving]):.2f} deg",
        "still: largest ratio of radii": f"{max(ratios):.3f}",
    }


MEASUREMENTS = {"rolling-shutter": Measurement(rows, needs_scenes=False)}
