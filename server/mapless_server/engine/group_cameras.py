"""The cameras of a rig's or a sequence's photographs that came without intrinsics: one for those that one camera took.

Each photograph is localized alone first, with a camera of its own (`cameras`). The camera of the photograph whose
matches determine the focal length best is then that of all, with the standard deviations that these matches leave, and
the others are localized again with it. Photographs of a camera that no photograph determines are left out.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import replace

from mapless_server.method.bundle.estimate import PosedSupport, determined_intrinsics
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import ChosenCamera
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason

from .cameras import CAMERA
from .query import Query, Result

LARGEST_FOCAL_SHARE = 0.05
"""A camera whose focal length has a larger standard deviation, as a share, is not known: a flat wall's photograph
leaves about so much."""


def common_cameras(
    queries: Sequence[Query], results: Sequence[Result], is_sequence: bool
) -> Mapping[int, ChosenCamera | None]:
    """The camera of each photograph without intrinsics, by its index; None where it is not known.

    A sequence has one camera; photographs of a rig have the same if make, model and size are in their EXIF and equal.
    """
    cameras = dict[int, ChosenCamera | None]()
    for indices in _of_one_camera(queries, is_sequence):
        known = [it for i in indices if (it := _determined(results[i])) is not None]
        best = min(known, key=_focal_share, default=None)
        is_known = best is not None and _focal_share(best) <= LARGEST_FOCAL_SHARE
        cameras |= dict.fromkeys(indices, best if is_known else None)
    return cameras


def _of_one_camera(queries: Sequence[Query], is_sequence: bool) -> Iterator[list[int]]:
    """Indices of the photographs without intrinsics, camera by camera."""
    of_camera = defaultdict[Hashable, list[int]](list)
    for i, query in enumerate(queries):
        photo, exif = query.photo, query.photo.exif
        if exif is None:
            continue
        key: Hashable = i
        if is_sequence:
            key = None
        elif exif.make and exif.model:
            key = exif.make, exif.model, photo.camera.width_px, photo.camera.height_px
        of_camera[key].append(i)
    yield from of_camera.values()


def _determined(result: Result) -> ChosenCamera | None:
    """The camera that a photograph was localized with, as its matches leave it; None without one."""
    chosen, support = result.camera, result.answer.support
    if chosen is None or chosen.sigma is None or not isinstance(result.answer.outcome, Localization):
        return chosen
    found = determined_intrinsics(support) if isinstance(support, PosedSupport) else None
    return chosen if found is None else replace(chosen, camera=found[0], sigma=found[1])


def _focal_share(camera: ChosenCamera) -> float:
    """Standard deviation of the focal length, as a share; 0 for a camera that is as certain as a given one."""
    return camera.sigma.focal_share if camera.sigma else 0.0


def read_with(query: Query, camera: ChosenCamera | None) -> Query:
    """The query of a photograph with the camera of its group; as it is without one."""
    if camera is None:
        return query
    photo = replace(query.photo, camera=camera.camera, exif=None)
    return replace(query, photo=photo, options=replace(query.options, intrinsics=camera.sigma))


def read_otherwise(results: Sequence[Result], cameras: Mapping[int, ChosenCamera | None]) -> list[int]:
    """Indices of the photographs that were localized with another camera than that of their group."""
    return [
        i
        for i, camera in cameras.items()
        if camera is not None and ((own := results[i].camera) is None or own.camera != camera.camera)
    ]


def answered(result: Result, index: int, cameras: Mapping[int, ChosenCamera | None]) -> Result:
    """The result with the camera of its group; without matches where that is not known, since they say nothing."""
    if index not in cameras:
        return result
    if (camera := cameras[index]) is not None:
        return replace(result, camera=camera)
    return replace(result, answer=replace(result.answer, outcome=_unknown(result), support=None), camera=None)


def _unknown(result: Result) -> Rejection:
    """The rejection of a photograph of a camera that neither it nor another one of the group determines."""
    outcome, camera = result.answer.outcome, _determined(result)
    reason, why = RejectionReason.GATE, "no photograph of it is localized alone"
    if isinstance(outcome, Rejection):
        reason, why = outcome.reason, f"{why} ({outcome.message})"
    elif camera is not None:
        share = f"{100 * _focal_share(camera):.0f} %"
        why = f"the photographs determine it to {share}, {100 * LARGEST_FOCAL_SHARE:.0f} % is needed"
    advice = "Send the camera's intrinsics, or photographs in which things at several distances match the references."
    message = f"the focal length of the photograph's camera is not known: {why}"
    return Rejection(reason, message, Hint(CAMERA, Advice.CHECK_CALIBRATION, advice))
