"""Whether two references are the same photograph, or add nothing to one another."""

from __future__ import annotations

from enum import Enum

import numpy as np

from mapless_server.method.views import Matches, PosedView

from .options import AuditOptions


class Likeness(Enum):
    """How alike two references are; greater values are more alike."""

    DIFFERENT = 0
    SAME_VIEW = 1
    """Taken from one place in one direction, without parallax between them."""
    SAME_PHOTOGRAPH = 2
    """One photograph, perhaps recompressed."""


def likeness(first: PosedView, second: PosedView, matches: Matches, options: AuditOptions) -> Likeness:
    """Compares the image positions of two photographs' matches, whatever their poses.

    Photographs of different sizes differ: positions are compared in the pixels that features were found in.
    """
    photographs = first.view.photograph, second.view.photograph
    if photographs[0] is not None and photographs[1] is not None and photographs[0].sha256 == photographs[1].sha256:
        return Likeness.SAME_PHOTOGRAPH
    cameras = first.view.camera, second.view.camera
    if (cameras[0].width_px, cameras[0].height_px) != (cameras[1].width_px, cameras[1].height_px):
        return Likeness.DIFFERENT
    matched_share = len(matches) / max(1, min(len(first.view.features), len(second.view.features)))
    if matched_share < min(options.same_photograph_share, options.same_view_matched_share):
        return Likeness.DIFFERENT
    shift = first.view.features.keypoints[matches[:, 0]] - second.view.features.keypoints[matches[:, 1]]
    shift_px = float(np.median(np.linalg.norm(shift, axis=1)))
    if shift_px < options.same_photograph_px and matched_share >= options.same_photograph_share:
        return Likeness.SAME_PHOTOGRAPH
    is_near = shift_px < options.same_view_share * cameras[0].width_px
    return Likeness.SAME_VIEW if is_near and matched_share >= options.same_view_matched_share else Likeness.DIFFERENT
