"""The references' keypoints, counted through all references: keypoint n of N is one of the first, ..., of the last."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .arrays import AnyArray, namespace
from .reconstruction import Reconstruction
from .views import PosedView


def keypoint_depths(reconstruction: Reconstruction, references: Sequence[PosedView]) -> Array:
    """Predicted depth (N,) at the references' keypoints, reconstruction units; NaN where there is none."""
    depths = [
        prediction.depth_at(reference.view.features.keypoints, reference.view.camera)
        for prediction, reference in zip(reconstruction.references, references, strict=True)
    ]
    depth: Array = positive(np.concatenate([np.empty(0), *depths]))
    return depth


def positive(depth: AnyArray) -> AnyArray:
    """Depths (N,), NaN for those that are none: not finite, or not above 0."""
    xp = namespace(depth)
    return xp.where(xp.isfinite(depth) & (depth > 0), depth, np.nan)


def keypoint_offsets(references: Sequence[PosedView]) -> NDArray[np.intp]:
    """Where (K + 1,) the keypoints of each reference begin when they are counted through all."""
    return np.cumsum([0] + [len(reference.view.features) for reference in references])


def keypoint_rays(references: Sequence[PosedView]) -> tuple[Array, Array]:
    """Of the references' keypoints, camera centres (N, 3) and viewing rays (N, 3) of depth 1, in the world."""
    poses = [reference.world_from_camera for reference in references]
    counts = [len(reference.view.features) for reference in references]
    rays = [r.view.camera.rays(r.view.features.keypoints) @ r.world_from_camera.rotation.T for r in references]
    return np.repeat([pose.translation for pose in poses], counts, axis=0), np.concatenate(rays)
