"""Notes of an import on depths that nothing else shows before photographs are localized: their unit and sensor."""

from collections.abc import Sequence

import numpy as np

from mapless.depth import NOISE, PLAUSIBLE_DEPTHS, DepthSensor
from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, decode_depth
from mapless_tools.dataset import Frame

LOOKED_AT = 5
"""Depths whose median is looked at, evenly spread: a wrong unit is that of all."""


def implausible_unit(frames: Sequence[Frame]) -> str:
    """A warning if the median depth of most frames with depth cannot be metres; empty otherwise."""
    measured = [frame for frame in frames if frame.depth is not None]
    chosen = [measured[i * len(measured) // LOOKED_AT] for i in range(LOOKED_AT)] if measured else []
    medians = [it for frame in dict.fromkeys(chosen) if (it := _median_m(frame)) is not None]
    least, most = PLAUSIBLE_DEPTHS
    wrong = [it for it in medians if not least <= it <= most]
    if 2 * len(wrong) <= len(medians):
        return ""
    of_all = "" if len(medians) == len(measured) else f" that were looked at, of {len(measured)},"
    return (
        f"depth: {len(wrong)} of {len(medians)}{of_all} have a median of {np.median(wrong):.4g} m, which is not used "
        f"({least:g} to {most:g} m are): is --depth-unit right, 0.001 for millimetres?"
    )


def unknown_sensor(frames: Sequence[Frame]) -> str:
    """A note on the frames whose depth has no stated sensor; empty without."""
    depths = [frame.depth for frame in frames if frame.depth is not None]
    count = sum(it.sensor is DepthSensor.UNKNOWN and it.noise is None for it in depths)
    if not count:
        return ""
    common = 100 * NOISE[DepthSensor.UNKNOWN].common
    return (
        f"depth: the sensor of {count} of {len(depths)} is not stated, so {common:g} % of their scale is in the radii: "
        "--depth-sensor names it"
    )


def _median_m(frame: Frame) -> float | None:
    """The median of a frame's depth; None if it cannot be read, as is said where it is refused."""
    size = frame.camera.width_px, frame.camera.height_px
    try:
        depth = frame.read_depth()
        return None if depth is None else float(np.nanmedian(decode_depth(depth, size, ANY_SIZE)))
    except (OSError, ValueError, InvalidArgument):
        return None
