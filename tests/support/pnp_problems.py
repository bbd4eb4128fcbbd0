"""Planted problems of the pose solver: points all over an image, and which of their matches are wrong."""

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import Features, View
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import ONE_PIXEL
from support.scenes import CAMERA

POSE = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
Problem = tuple[View, Structure, PointMatches]


def problem_of(x_in_world: Array, pixels: Array) -> Problem:
    """Point i matched with keypoint i."""
    n = len(x_in_world)
    index = np.arange(n)
    features = Features(pixels.astype(np.float32), np.ones((n, 1), np.float32), np.ones(n, np.float32))
    structure = Structure(x_in_world, Tracks(index[:0], index[:0], index[:0]), ONE_PIXEL)
    return View(CAMERA, features), structure, PointMatches(index, index, np.zeros(n, bool), 0.0)


def planted(random: np.random.Generator, count: int, noise_px: float = 0.5, outlier_share: float = 0.0) -> Problem:
    """Points all over the image of a camera at POSE; the first of their matches are wrong."""
    pixels = random.uniform([0, 0], [959, 719], (count, 2))
    x_in_world = POSE.apply(CAMERA.rays(pixels) * random.uniform(3, 6, (count, 1)))
    pixels += random.normal(0, noise_px, pixels.shape)
    wrong = np.arange(count) < outlier_share * count
    return problem_of(x_in_world, np.where(wrong[:, None], random.uniform([0, 0], [959, 719], (count, 2)), pixels))
