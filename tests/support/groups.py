"""Groups of photographs with a planted truth: several cameras in one synthetic scene."""

import itertools
from collections.abc import Sequence

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.estimate import PoseStage, Support
from mapless_server.method.features.views import Matches
from mapless_server.method.groups.images import GroupImage
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.match import MatchOptions
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import KeypointNoise
from support.planted import true_structure
from support.scenes import SceneOptions, SyntheticScene, look_at, make_scene, observe

NOISE = KeypointNoise(0.5, 0.0)
MATCH = MatchOptions()
NOT_ALONE = Rejection(RejectionReason.PNP_FAILED, "alone")
NOTHING = GroupImage(Answer(Rejection(RejectionReason.LOW_TEXTURE, "blank")), MATCH)

ORIGIN = np.array([30.0, -20.0, 500_000.0])
"""Where the scene's world is in the caller's."""


def looking(*centres: Sequence[float]) -> list[RigidTransform]:
    """Cameras at these places that look about the middle of the scene's box."""
    return [look_at(np.array(centre), np.array([0.1 * i, 0.02 * i, 0.0])) for i, centre in enumerate(centres)]


def walk(random: np.random.Generator, count: int, step_m: float = 0.15) -> list[RigidTransform]:
    """A walk past the box."""
    x = (np.arange(count) - (count - 1) / 2) * step_m
    return looking(*[(x[i], 0.05 * np.sin(i), -4.0 + 0.1 * np.cos(i / 2)) for i in range(count)])


def drifting(
    random: np.random.Generator, world_from_camera: Sequence[RigidTransform], share: float, deg: float = 0.0
) -> list[RigidTransform]:
    """`session_from_camera` of a device that loses such a share of each step, always in one direction."""
    bias, axis = random.normal(size=3), random.normal(size=3)
    bias, axis = bias / np.linalg.norm(bias), axis / np.linalg.norm(axis)
    poses = [RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 2, 3))]
    for first, second in itertools.pairwise(world_from_camera):
        step = first.inverse().compose(second)
        length_m = float(np.linalg.norm(step.translation))
        wrong = RigidTransform(
            rotation_from_vector(np.radians(deg) * axis) @ step.rotation, step.translation + share * length_m * bias
        )
        poses.append(poses[-1].compose(wrong))
    return poses


def rescaled(session_from_camera: Sequence[RigidTransform], unit: float) -> list[RigidTransform]:
    """The same poses where a metre is so many units."""
    return [RigidTransform(pose.rotation, unit * pose.translation) for pose in session_from_camera]


def images_of(
    random: np.random.Generator,
    world_from_camera: Sequence[RigidTransform],
    options: SceneOptions | None = None,
    *,
    keep: int | Sequence[int] = 200,
    wrong_share: float = 0.0,
    alone: Sequence[bool] | bool = False,
    own_noise_m: float = 0.0,
) -> list[GroupImage]:
    """Photographs of one scene at these poses.

    Args:
        random: of everything.
        world_from_camera: where they are taken, in the scene's world; the answers are in the caller's.
        options: of the scene.
        keep: right matches of each photograph at most.
        wrong_share: of all its matches, those that are wrong.
        alone: whether it was localized alone.
        own_noise_m: error of that.
    """
    options = options or SceneOptions(point_count=250, noise_px=0.5)
    scene = make_scene(random, options)
    keeps = [keep] * len(world_from_camera) if isinstance(keep, int) else list(keep)
    alones = [alone] * len(world_from_camera) if isinstance(alone, bool) else list(alone)
    images = []
    for pose, most, is_posed in zip(world_from_camera, keeps, alones, strict=True):
        view, shown = observe(random, options, scene.x_in_world, scene.descriptors, pose)
        seen = SyntheticScene(
            scene.x_in_world, scene.descriptors, scene.references, scene.reference_points, view, shown, pose
        )
        structure, matches = true_structure(seen, NOISE)
        chosen = np.sort(random.permutation(len(matches))[:most])
        point, keypoint = matches.point[chosen], matches.keypoint[chosen]
        wrong = random.permutation(len(chosen))[: round(wrong_share * len(chosen))]
        point[wrong] = np.roll(point[wrong], 1)
        matches = PointMatches(point, keypoint, np.zeros(len(point), bool), 6.0)
        its_matches = matches_with_references(structure, matches, len(scene.references))
        support = Support(view, scene.references, structure, matches, ORIGIN, query_matches=its_matches)
        outcome: Localization | Rejection = NOT_ALONE
        if is_posed:
            off = pose.shifted(ORIGIN + random.normal(0, own_noise_m, 3))
            outcome = Localization(off, np.eye(6) * 1e-4, PoseStage.REFINED, len(point), len(point), 0.5)
        images.append(GroupImage(Answer(outcome, support=support), MATCH))
    return images


def matches_with_references(structure: Structure, matches: PointMatches, count: int) -> tuple[Matches, ...]:
    """Matches of a photograph with each of the references that observe its points."""
    keypoint_of = np.full(len(structure.x_in_world), -1)
    keypoint_of[matches.point] = matches.keypoint
    tracks = structure.tracks
    pairs = np.stack([keypoint_of[tracks.point], tracks.keypoint], axis=1)
    return tuple(pairs[(tracks.view == view) & (pairs[:, 0] >= 0)] for view in range(count))


def caller_pose(world_from_camera: RigidTransform) -> RigidTransform:
    """A pose of the scene's world in the caller's."""
    return world_from_camera.shifted(ORIGIN)


def error_m(pose: RigidTransform, truth: RigidTransform) -> float:
    """Between a pose in the caller's world and the truth in the scene's."""
    difference: Array = pose.translation - caller_pose(truth).translation
    return float(np.linalg.norm(difference))
