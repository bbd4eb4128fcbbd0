"""The structure stage's tracks and observations on a device; its equations are those of `observations`.

Removing rows of a tensor would make the host wait for the number of remaining ones. So every point has the same number
of rows; those without an observation, or whose observation is dropped, are blank.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..arrays import AnyArray
from ..observations import Observations
from ..results import KeypointNoise
from ..tracks import Tracks, keypoint_offsets, keypoint_rays
from ..views import PosedView


@dataclass(frozen=True, eq=False)
class StructureInputs:
    """The input of the structure without the reconstruction: P points in at most L of K references.

    Attributes:
        keypoint: (P, L) observations, as keypoints counted through all references; then -1 for blank rows.
        view: (P, L) their reference; 0 where blank.
        pixel: (N, 2) float32, pixels of the keypoints.
        size_px: (N,) float32, sizes of the keypoints.
        rotation: (K, 3, 3) camera_from_world.
        translation: (K, 3) translation of the same pose, metres.
        focal_px, principal_px: (K, 2) intrinsics of the references.
        first_centre, first_ray: (P, 3) camera centre and viewing ray of each point's first observation, in the world.
    """

    keypoint: AnyArray
    view: AnyArray
    pixel: AnyArray
    size_px: AnyArray
    rotation: AnyArray
    translation: AnyArray
    focal_px: AnyArray
    principal_px: AnyArray
    first_centre: AnyArray
    first_ray: AnyArray


def prepare_structure(tracks: Tracks, references: Sequence[PosedView]) -> tuple[StructureInputs, NDArray[np.intp]]:
    """Makes the inputs, and the index (O,) of each observation of the tracks among the flattened (P, L)."""
    column = np.arange(len(tracks.point)) - tracks.starts[tracks.point]
    shape = (tracks.point_count, int(column.max(initial=0)) + 1)
    keypoint, view = np.full(shape, -1), np.zeros(shape, np.int64)
    keypoint[tracks.point, column] = keypoint_offsets(references)[tracks.view] + tracks.keypoint
    view[tracks.point, column] = tracks.view

    camera_from_world = [r.world_from_camera.inverse() for r in references]
    cameras = [r.view.camera for r in references]
    centre, ray = keypoint_rays(references)
    inputs = StructureInputs(
        keypoint,
        view,
        np.concatenate([r.view.features.keypoints for r in references]),
        np.concatenate([r.view.features.sizes_px for r in references]),
        np.stack([c.rotation for c in camera_from_world]),
        np.stack([c.translation for c in camera_from_world]),
        np.array([(c.focal_x_px, c.focal_y_px) for c in cameras]),
        np.array([(c.principal_x_px, c.principal_y_px) for c in cameras]),
        centre[keypoint[:, 0]],
        ray[keypoint[:, 0]],
    )
    return inputs, tracks.point * shape[1] + column


@dataclass(frozen=True, eq=False)
class DeviceTracks:
    """`Tracks` on a device (see tracks.Grouping): L rows for each of P points.

    Sums run over a point's rows in their order, so that an answer is reproducible; atomic additions are not.

    Attributes:
        seen: (P, L) which rows have an observation.
    """

    seen: Tensor

    @cached_property
    def point(self) -> Tensor:
        """See Grouping."""
        return torch.arange(self.seen.numel(), device=self.seen.device) // self.seen.shape[1]

    @cached_property
    def starts(self) -> Tensor:
        """See Grouping; for a point without rows, a blank one."""
        count, width = self.seen.shape
        return torch.arange(count, device=self.seen.device) * width + self.seen.byte().argmax(1)

    @cached_property
    def length(self) -> Tensor:
        """See Grouping."""
        return (self.seen * self.seen.sum(1, keepdim=True)).reshape(-1)

    def sum_by_point(self, values: Tensor) -> Tensor:
        """See Tracks."""
        return self._by_point(values, 0.0).sum(1)

    def sum_columns(self, values: Tensor) -> Tensor:
        """See Tracks."""
        rows = values.reshape(*values.shape[:-1], *self.seen.shape)
        return rows.masked_fill(self._blank, 0.0).sum(-1)

    def max_by_point(self, values: Tensor) -> Tensor:
        """See Tracks; minus infinity for a point without rows."""
        return self._by_point(values, -torch.inf).amax(1)

    def prune(self, observations: Tensor) -> "tuple[DeviceTracks, slice, slice]":
        """See Tracks; the rows are not moved."""
        seen = self.seen & observations.reshape(self.seen.shape)
        often = seen.sum(1, keepdim=True) >= 2
        return DeviceTracks(seen & often), slice(None), slice(None)

    @cached_property
    def _blank(self) -> Tensor:
        return ~self.seen

    def _by_point(self, values: Tensor, blank: float) -> Tensor:
        rows = values.reshape(*self.seen.shape, *values.shape[1:])
        return rows.masked_fill(self._blank.reshape(*self.seen.shape, *[1] * (values.ndim - 1)), blank)


def observe_on_device(inputs: StructureInputs, noise: KeypointNoise) -> Observations:
    """Makes the observations of the tracks, float64; blank rows hold the first keypoint."""
    keypoint, view = inputs.keypoint.clip(0).reshape(-1), inputs.view.reshape(-1)
    size_px = inputs.size_px[keypoint].double()
    return Observations(
        DeviceTracks(inputs.keypoint >= 0),
        inputs.pixel[keypoint].double(),
        size_px,
        noise.sigma_px(size_px),
        inputs.rotation[view],
        inputs.translation[view],
        inputs.focal_px[view],
        inputs.principal_px[view],
    )
