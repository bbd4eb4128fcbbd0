"""Cameras, poses and points from matches, by pycolmap's mappers, and which photographs they leave out and why."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from mapless.geometry import Array, RigidTransform
from mapless_tools.progress import Progress, tracked

from .cameras import from_colmap
from .matching import SEED, Evidence
from .native import interruptible
from .pictures import Omitted, Part, Picture, PosedPicture
from .refining import refine
from .turning import only_turned

FEWEST = 3
"""Photographs of a part: with two nothing confirms their poses."""
PARALLAX_DEG = 1.5
"""Least angle at a point between two photographs, for half of the points: below, distances are not determined.
Evidence: parallax."""
FEWEST_MATCHES = pycolmap.IncrementalPipelineOptions().min_num_matches
"""Matches of two photographs that agree, with which the mapper uses a pair."""
_LONGEST = 2.0
"""Largest focal length that is found, over that of the longest lens to begin with: with no bound, strong distortion is
explained by one of several times its length."""
_NO_PARALLAX = frozenset(
    int(it)
    for it in (
        pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
        pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
    )
)


def map_photographs(
    database: Path, folder: Path, count: int, known: Collection[int], threads: int, progress: Progress
) -> None:
    """Writes pycolmap's models of a database into a folder: 0, 1, ...; none if no photographs fit together.

    The incremental mapper measures best; where it finds no beginning, the global one, which needs none, is tried.
    Neither shows whether the camera moved, which `read_parts` judges. Cameras with the `known` ids stay as they are.
    """
    registered = 0

    def add() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("poses", registered, count)

    progress("poses", 0, count)
    folder.mkdir()
    map_incrementally(database, folder, known, threads, add)
    if not any(folder.iterdir()):
        map_globally(database, folder, threads)
    progress("poses", count, count)
    with pycolmap.Database.open(database) as content:
        given = {it.camera_id: it for it in content.read_all_cameras()}
    found = sorted(folder.iterdir())
    for place in tracked("refinement", found, len(found), progress):
        model = pycolmap.Reconstruction(str(place))
        restored = set(known) & set(model.cameras)
        for number in restored:
            model.cameras[number].params = given[number].params.tolist()  # the global mapper refines all
        if restored:
            model.write(str(place))
        if model.num_reg_images() >= FEWEST and refine(model, known, threads):
            model.write(str(place))


def map_incrementally(
    database: Path, folder: Path, known: Collection[int], threads: int, add: Callable[[], None] = lambda: None
) -> None:
    """Runs pycolmap's incremental mapper; `add` is called with each photograph that it adds."""
    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=FEWEST,
        extract_colors=False,
        num_threads=threads,
        random_seed=SEED,
        constant_cameras=set(known),
        max_focal_length_ratio=_LONGEST * _longest_focal_ratio(database),
    )
    token = pycolmap.CancellationToken()
    interruptible(
        lambda: pycolmap.incremental_mapping(
            database, database.parent, folder, options, next_image_callback=add, cancellation_token=token
        ),
        token.cancel,
    )


def map_globally(database: Path, folder: Path, threads: int) -> None:
    """Runs pycolmap's global mapper."""
    options = pycolmap.GlobalPipelineOptions(min_model_size=FEWEST, num_threads=threads, random_seed=SEED)
    interruptible(lambda: pycolmap.global_mapping(database, database.parent, folder, options))


def _longest_focal_ratio(database: Path) -> float:
    """The largest focal length of the cameras of a database over the longer side."""
    with pycolmap.Database.open(database) as content:
        return max(it.mean_focal_length() / max(it.width, it.height) for it in content.read_all_cameras())


def read_parts(
    database: Path, folder: Path, pictures: Sequence[Picture], evidence: Sequence[Evidence]
) -> tuple[Part, ...]:
    """The models of a folder that have parallax, the one with most photographs first."""
    by_name = {it.name: it for it in pictures}
    models = [pycolmap.Reconstruction(str(it)) for it in sorted(folder.iterdir(), key=lambda it: int(it.name))]
    enough = [it for it in models if it.num_reg_images() >= FEWEST]
    moved = [it for it in enough if not only_turned(database, it.reg_image_ids())]
    parts = [_part(it, by_name, evidence) for it in moved if parallax_deg(it) >= PARALLAX_DEG]
    return tuple(sorted(parts, key=lambda it: -len(it.posed)))


def why_no_part(database: Path, folder: Path) -> str:
    """A sentence that says why no photographs of a database, with the models of a folder, got poses."""
    verified = _verified(database)
    if not verified:
        return (
            "no two photographs show the same place clearly enough to be compared: take photographs that overlap by "
            "more than half, sharp and lit"
        )
    if any(folder.iterdir()) or _without_parallax(verified):
        return (
            "the camera seems only to have turned, or stood still while something moved: photographs differ as those "
            "from one place do, so that nothing shows how far it moved, or all show one flat surface; move the camera "
            "by a step between photographs"
        )
    return (
        "too few photographs fit together for poses: at least three must show the same place from different positions"
    )


def _verified(database: Path) -> list[pycolmap.TwoViewGeometry]:
    """The geometries of pairs that have one."""
    with pycolmap.Database.open(database) as content:
        return [it for it in content.read_two_view_geometries()[1] if len(it.inlier_matches) >= FEWEST_MATCHES]


def _without_parallax(geometries: Sequence[pycolmap.TwoViewGeometry]) -> bool:
    """Whether most pairs are explained by a turn of the camera, or by a plane, alone."""
    return sum(int(it.config) in _NO_PARALLAX for it in geometries) > len(geometries) / 2


def omitted(part: Part, parts: Sequence[Part], pictures: Sequence[Picture], database: Path) -> tuple[Omitted, ...]:
    """The photographs that have no pose in a part, each with the reason."""
    found = {it.picture.name for it in part.posed}
    images = {number: picture.name for number, picture in enumerate(pictures, 1)}
    shared = dict.fromkeys(images.values(), 0)
    with pycolmap.Database.open(database) as content:
        pairs, counts = content.read_two_view_geometry_num_inliers()
    for pair, count in zip(pairs, counts, strict=True):
        first, second = (images[it] for it in pycolmap.pair_id_to_image_pair(pair))
        for one, other in ((first, second), (second, first)):
            if other in found:
                shared[one] = max(shared[one], count)
    of_other = {it.picture.name: f"it is in part {i}" for i, other in enumerate(parts, 1) for it in other.posed}
    left_out = [it for it in images.values() if it not in found]
    return tuple(Omitted(it, of_other.get(it) or matches_reason(shared[it])) for it in left_out)


def matches_reason(matches: int) -> str:
    """Why a photograph has no pose that shares at most so many matches with one that has."""
    if matches < FEWEST_MATCHES:
        return f"too few matches: no photograph with a pose shares {FEWEST_MATCHES} that agree"
    return f"it shares {matches} matches with a photograph that has a pose, too few of them with points"


def _part(model: pycolmap.Reconstruction, by_name: Mapping[str, Picture], evidence: Sequence[Evidence]) -> Part:
    points = list(model.points3D.values())
    posed = []
    for image in sorted(model.images.values(), key=lambda it: it.image_id):
        if image.has_pose:
            camera_from_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
            pose = RigidTransform.from_matrix(camera_from_world).inverse()
            camera = from_colmap(model.cameras[image.camera_id])
            posed.append(PosedPicture(by_name[image.name], camera, pose, image.num_points3D))
    x_in_world = np.array([it.xyz for it in points]).reshape(-1, 3)
    return Part(tuple(posed), x_in_world, _colours(model, points, evidence), model.compute_mean_reprojection_error())


def _colours(model: pycolmap.Reconstruction, points: Sequence[pycolmap.Point3D], evidence: Sequence[Evidence]) -> Array:
    """Mean colours (N, 3) of the keypoints of each point."""
    sums, counts = np.zeros((len(points), 3)), np.zeros(len(points))
    seen: dict[int, list[tuple[int, int]]] = {}
    for row, point in enumerate(points):
        for element in point.track.elements:
            seen.setdefault(element.image_id, []).append((row, element.point2D_idx))
    for image_id, pairs in seen.items():
        rows, keypoints = np.array(pairs).T
        colours = np.concatenate([it.features.colours(model.images[image_id].name) for it in evidence])
        np.add.at(sums, rows, colours[keypoints])
        np.add.at(counts, rows, 1)
    return np.asarray(sums / np.maximum(counts, 1)[:, None])


def parallax_deg(model: pycolmap.Reconstruction) -> float:
    """The median over points of the largest angle between two photographs that see it; 0 without points."""
    centres = {it.image_id: it.projection_center() for it in model.images.values() if it.has_pose}
    angles = []
    for point in model.points3D.values():
        rays = np.array([centres[it.image_id] for it in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(float((rays @ rays.T).min()))
    return float(np.degrees(np.arccos(np.clip(np.median(angles), -1, 1)))) if angles else 0.0
