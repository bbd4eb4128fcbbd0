"""Cases in which a photograph may have several poses, by kind, and what is expected of each."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from zlib import crc32

import cv2
import numpy as np

from mapless import (
    Camera,
    GravityPrior,
    HeadingPrior,
    PosePrior,
    PositionPrior,
    Priors,
    RigidTransform,
)
from mapless.geometry import rotation_from_vector
from mapless_tools.dataset import Frame
from research.places import (
    APART,
    BOX,
    CAN,
    CHESS,
    FOUNTAIN,
    KITCHEN,
    LOCKERS,
    MEETING,
    STATUE,
    Place,
    Scenes,
)

ELSEWHERE_RADII = 50.0
"""How far away a prior of another place is, in radii of the scene."""
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Camera axes of a raster that is turned by 90 degrees counterclockwise, from those of the raster: x' = y, y' = -x."""


class Expected(StrEnum):
    """The answer that is expected; any other pose than the true one is wrong in every case."""

    RIGHT = "right"
    RIGHT_OR_REJECTED = "right or rejected"
    REJECTED = "rejected"
    AMBIGUOUS = "rejected as ambiguous"


@dataclass(frozen=True, eq=False)
class Case:
    """A photograph that is asked in a place; `image` makes its bytes. No pose is right where `true_pose` is None."""

    kind: str
    name: str
    place: Place
    image: Callable[[], bytes]
    camera: Camera
    true_pose: RigidTransform | None
    expected: Expected
    priors: Priors | None = None


def _case(kind: str, place: Place, frame: Frame, expected: Expected, form: str = "", asked_of: str = "") -> Case:
    name = " ".join(filter(None, (f"{asked_of}{frame.name}", "in", place.scene, form)))
    pose = frame.world_from_camera
    return Case(kind, name, place, frame.image_path.read_bytes, frame.camera, pose, expected)


def _plain(kind: str, scenes: Scenes, chosen: Sequence[tuple[str, int, int]]) -> Iterator[Case]:
    for folder, references, count in scenes.present(chosen):
        place = scenes.place(folder, references)
        for frame in place.queries(count):
            yield _case(kind, place, frame, Expected.RIGHT_OR_REJECTED)


def repeated(scenes: Scenes) -> Iterator[Case]:
    """Rows of equal lockers, a can whose print repeats on equal tiles, and a statue that looks alike from all sides."""
    return _plain("repeated", scenes, [(LOCKERS, 8, 10), (LOCKERS, 10, 8), (CAN, 6, 8), (STATUE, 18, 12)])


def sparse(scenes: Scenes) -> Iterator[Case]:
    """Few references, far apart."""
    return _plain("sparse", scenes, [(KITCHEN, 3, 8), (MEETING, 5, 8), (FOUNTAIN, 3, 6), (CHESS, 5, 6)])


def mirrored(scenes: Scenes) -> Iterator[Case]:
    """Photographs with left and right exchanged, as of a mirror: no pose is right."""
    asked = [(KITCHEN, 10, 4), (LOCKERS, 10, 4), (FOUNTAIN, 5, 3), (CAN, 6, 4), (MEETING, 10, 4), (STATUE, 18, 4)]
    for folder, references, count in scenes.present([*asked, (BOX, 8, 4)]):
        place = scenes.place(folder, references)
        for frame in place.queries(count):
            camera = frame.camera
            seen = replace(camera, principal_x_px=camera.width_px - 1 - camera.principal_x_px)
            case = _case("mirrored", place, frame, Expected.REJECTED, "mirrored")
            image = _changed(frame, lambda pixels: pixels[:, ::-1])
            yield replace(case, image=image, camera=seen, true_pose=None)


def turned(scenes: Scenes) -> Iterator[Case]:
    """Rasters that are turned by 90, 180 and 270 degrees, with their intrinsics."""
    places = [scenes.place(*it) for it in scenes.present([(KITCHEN, 10), (LOCKERS, 10), (FOUNTAIN, 5), (MEETING, 10)])]
    asked = [(place, frame) for place in places for frame in place.queries(2)]
    for quarters in (1, 2, 3):
        for place, frame in asked:
            camera, pose = frame.camera, frame.world_from_camera
            for _ in range(quarters):
                camera, pose = quarter_turn(camera, pose)
            case = _case("turned", place, frame, Expected.RIGHT_OR_REJECTED, f"turned by {90 * quarters}")
            image = _changed(frame, lambda pixels, by=quarters: np.rot90(pixels, by))
            yield replace(case, image=image, camera=camera, true_pose=pose)


def quarter_turn(camera: Camera, world_from_camera: RigidTransform) -> tuple[Camera, RigidTransform]:
    """Camera and pose of the raster that is turned by 90 degrees counterclockwise, as by `numpy.rot90`.

    Tangential distortion is not turned: the lens must have none.
    """
    seen = replace(
        camera,
        width_px=camera.height_px,
        height_px=camera.width_px,
        focal_x_px=camera.focal_y_px,
        focal_y_px=camera.focal_x_px,
        principal_x_px=camera.principal_y_px,
        principal_y_px=camera.width_px - 1 - camera.principal_x_px,
    )
    return seen, RigidTransform(world_from_camera.rotation @ TURN.T, world_from_camera.translation)


def _changed(frame: Frame, change: Callable[..., np.ndarray]) -> Callable[[], bytes]:
    """The photograph with changed pixels, without further losses."""

    def image() -> bytes:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = cv2.imdecode(np.frombuffer(frame.image_path.read_bytes(), np.uint8), flags)
        return bytes(cv2.imencode(".png", np.ascontiguousarray(change(pixels)))[1].tobytes())

    return image


PRIOR_PLACES = ((KITCHEN, 5), (LOCKERS, 10), (MEETING, 10), (STATUE, 18), (CAN, 6))
TIGHT, LOOSE = (0.05, 2.0), (0.5, 15.0)
"""Standard deviations of priors: of positions, in radii of the scene, and of directions, degrees."""


def right_priors(scenes: Scenes) -> Iterator[Case]:
    """Priors that are as far off as their standard deviations say, tight and loose, and limits that hold."""
    for place, frame, i in _asked(scenes):
        given = list(_priors_about(place, frame.world_from_camera, frame, frame.name).items())
        pose, limits = frame.world_from_camera, ("hard position and heading", _limits(place, frame.world_from_camera))
        for form, priors in _three(i, [*given, limits]):
            case = _case("right-priors", place, frame, Expected.RIGHT_OR_REJECTED, form)
            yield replace(case, priors=priors, true_pose=pose)


def wrong_priors(scenes: Scenes) -> Iterator[Case]:
    """Priors of photographs far away, of other directions and of other places, and limits that exclude the truth."""
    for place, frame, i in _asked(scenes):
        pose, far = frame.world_from_camera, place.far_from(frame)
        by_far = _priors_about(place, far, frame, frame.name)
        beyond = pose.shifted([ELSEWHERE_RADII * place.radius, 0.0, 0.0])
        about_down = rotation_from_vector(np.radians(60) * place.down())
        gravity = GravityPrior(np.array([1.0, 0.0, 0.0]), 3.0, pose.rotation[:, 1])
        half = 0.5 * float(np.linalg.norm(far.translation - pose.translation))
        soft = {
            "pose of a photograph far away, tight": by_far["pose, tight"],
            "pose of a photograph far away, loose": by_far["pose, loose"],
            "position of a photograph far away, tight": by_far["position, tight"],
            "heading reversed": Priors(heading=HeadingPrior(-pose.rotation[:, 2], sigma_deg=5.0)),
            "heading off by 60 degrees": Priors(heading=HeadingPrior(about_down @ pose.rotation[:, 2], sigma_deg=5.0)),
            "gravity off by 90 degrees": Priors(gravity=gravity),
            "pose of another place": Priors(pose=PosePrior.from_sigmas(beyond, 0.05 * place.radius, 2.0)),
        }
        hard = {
            "limit of the position elsewhere": Priors(position=PositionPrior(far.translation, radius_m=half)),
            "limit of the heading reversed": Priors(heading=HeadingPrior(-pose.rotation[:, 2], max_angle_deg=45.0)),
        }
        for form, priors in _three(i, [*soft.items(), *hard.items()]):
            expected = Expected.REJECTED if form in hard else Expected.RIGHT_OR_REJECTED
            yield replace(_case("wrong-priors", place, frame, expected, form), priors=priors)


def _asked(scenes: Scenes) -> Iterator[tuple[Place, Frame, int]]:
    """Places and photographs that are asked with priors, and their numbers."""
    for i, (folder, references) in enumerate(scenes.present(PRIOR_PLACES)):
        place = scenes.place(folder, references)
        for j, frame in enumerate(place.queries(4)):
            yield place, frame, 4 * i + j


def _three(i: int, forms: Sequence[tuple[str, Priors]]) -> list[tuple[str, Priors]]:
    """Three of the forms of priors, so that all are asked equally often."""
    return [forms[(3 * i + i // 3 + k) % len(forms)] for k in range(3)]


def _priors_about(place: Place, pose: RigidTransform, frame: Frame, seed: str) -> dict[str, Priors]:
    """Soft priors of each kind, tight and loose, off a pose by random errors of their standard deviations."""
    random, found = np.random.default_rng(crc32(seed.encode())), dict[str, Priors]()
    for name, (radii, sigma_deg) in (("tight", TIGHT), ("loose", LOOSE)):
        sigma = radii * place.radius
        off = pose.translation + sigma * random.standard_normal(3)
        turn = rotation_from_vector(np.radians(sigma_deg) * random.standard_normal(3))
        down = turn.T @ pose.rotation.T @ place.down()
        given = RigidTransform(turn @ pose.rotation, off)
        found |= {
            f"pose, {name}": Priors(pose=PosePrior.from_sigmas(given, sigma, sigma_deg)),
            f"position, {name}": Priors(position=PositionPrior(off, covariance_m2=sigma**2 * np.eye(3))),
            f"gravity, {name}": Priors(gravity=GravityPrior(down, sigma_deg, place.down())),
            f"heading, {name}": Priors(heading=HeadingPrior(turn @ pose.rotation[:, 2], sigma_deg=sigma_deg)),
        }
    return found


def _limits(place: Place, pose: RigidTransform) -> Priors:
    return Priors(
        position=PositionPrior(pose.translation, radius_m=0.5 * place.radius),
        heading=HeadingPrior(pose.rotation[:, 2], max_angle_deg=30.0),
    )


COPIED = ((KITCHEN, 10, 1), (FOUNTAIN, 5, 1), (BOX, 8, 2), (LOCKERS, 20, 2))


def two_places(scenes: Scenes) -> Iterator[Case]:
    """Two places that look alike: without a prior both poses are as good, and a prior says which is meant.

    In some the second has half of the references, so that it explains less of the photograph.
    """
    for folder, references, copy_stride in scenes.present(COPIED):
        place = scenes.place(folder, references, copy_stride)
        with_prior = Expected.RIGHT if copy_stride == 1 else Expected.RIGHT_OR_REJECTED
        without = Expected.AMBIGUOUS if copy_stride == 1 else Expected.RIGHT_OR_REJECTED
        for frame in place.queries(2):
            pose = frame.world_from_camera
            other = pose.shifted([APART, 0.0, 0.0])
            yield _case("two-places", place, frame, without, "without a prior")
            for side, true in (("first", pose), ("second", other)):
                given = RigidTransform(true.rotation, true.translation + [0.0, 0.03 * place.radius, 0.0])
                sides = {
                    "pose": Priors(pose=PosePrior.from_sigmas(given, 0.05 * place.radius, 2.0)),
                    "loose position": Priors(position=PositionPrior(given.translation, covariance_m2=9 * np.eye(3))),
                    "limit": Priors(position=PositionPrior(given.translation, radius_m=10.0)),
                }
                for form, priors in sides.items():
                    case = _case("two-places", place, frame, with_prior, f"{form} at the {side}")
                    yield replace(case, priors=priors, true_pose=true)
            heading = Priors(heading=HeadingPrior(pose.rotation[:, 2], sigma_deg=5.0))
            case = _case("two-places", place, frame, without, "heading, which fits both")
            yield replace(case, priors=heading)


CROSSED = (
    (KITCHEN, 10),
    (LOCKERS, 10),
    (FOUNTAIN, 5),
    (CAN, 6),
    (STATUE, 18),
    (MEETING, 5),
    (CHESS, 5),
    (BOX, 8),
)


def other_places(scenes: Scenes) -> Iterator[Case]:
    """Photographs of each scene, asked in each of the others."""
    places = [scenes.place(folder, references) for folder, references in scenes.present(CROSSED)]
    for place in places:
        others = [it for it in places if it is not place]
        for frame, other in zip(place.queries(len(others)), others, strict=False):
            case = _case("other-places", other, frame, Expected.REJECTED, asked_of=f"{place.scene}: ")
            yield replace(case, true_pose=None)


KINDS: dict[str, Callable[[Scenes], Iterator[Case]]] = {
    "sparse": sparse,
    "repeated": repeated,
    "mirrored": mirrored,
    "turned": turned,
    "right-priors": right_priors,
    "wrong-priors": wrong_priors,
    "two-places": two_places,
    "other-places": other_places,
}


def cases_of(scenes: Scenes, kinds: Sequence[str] = tuple(KINDS), every: int = 1) -> list[Case]:
    """Every so many-th case of each kind, in the scenes that there are; ValueError without any."""
    found = [case for kind in kinds for case in list(KINDS[kind](scenes))[::every]]
    if not found:
        raise ValueError(f"{scenes.folder} has none of the scenes of the cases {', '.join(kinds)}")
    return found
