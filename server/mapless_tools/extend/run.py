"""The order of the steps, from photographs without poses to references of a scene.

What takes long is kept in a folder, under names made of what it depends on, so that an interrupted run continues. The
references are fetched through the server, the photographs that fit are stored through it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pycolmap

from mapless import Client, Reference
from mapless import Scene as KnownScene
from mapless.provenance import PLACED, Provenance
from mapless_server.choices import AUTO
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.serve.features import ANY_ROLL
from mapless_server.settings import available_cores
from mapless_tools.dataset import Dataset, Frame, legal_id
from mapless_tools.ingest.existing import KnownReferences
from mapless_tools.ingest.report import ImportReport
from mapless_tools.ingest.upload import Uploader
from mapless_tools.progress import Progress, labelled, tracked
from mapless_tools.reconstruct.cameras import StartingCamera, starting_cameras
from mapless_tools.reconstruct.matching import Evidence, pairs_of
from mapless_tools.reconstruct.pictures import Omitted, Picture, Pictures
from mapless_tools.reconstruct.run import database_of, gather, made_once

from .existing import KnownPicture, check_scene, fetch_references, surveyed_of
from .model import Fixed, build_model, read_model
from .options import ExtendOptions
from .pairs import pairs_with_references
from .placing import Placed, Placement, place


@dataclass(frozen=True, eq=False)
class Extension:
    """The result of placing photographs in a scene.

    `pictures` are those that were tried, by name; `omitted` all that are not placed, `notes` what is said of the
    references and of how the photographs were read.
    """

    scene: KnownScene
    pictures: Mapping[str, Picture]
    placement: Placement
    omitted: tuple[Omitted, ...]
    notes: tuple[str, ...]


def extend(
    client: Client, scene: str, pictures: Pictures, work: Path, options: ExtendOptions, progress: Progress
) -> tuple[Extension, Sequence[Reference]]:
    """Places photographs in a scene, and stores nothing; also returns the scene's references.

    ValueError if the scene has too few references. MaplessError as the client.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    known = client.get_scene(scene)
    references = list(client.list_references(scene, page_size=1000))
    surveyed = surveyed_of(references)
    check_scene(scene, surveyed)
    new, there = _new_pictures(pictures.chosen, references)
    omitted, notes = [*pictures.omitted, *there], [*pictures.notes, *known.warnings]
    placement = Placement((), ())
    if new:
        wanted, alike = _similar(client, scene, new, surveyed, options, progress)
        found, damaged = fetch_references(client, scene, work / "references", wanted, progress)
        notes += [f"not used: {it}" for it in damaged.values()]
        check_scene(scene, surveyed if len(found) > 1 else surveyed[: len(found)])
        placement = placed_among(found, new, alike, work, options, progress)
        omitted += placement.omitted
    by_name = {it.name: it for it in new}
    return Extension(known, by_name, placement, tuple(omitted), tuple(notes)), references


def _new_pictures(pictures: Sequence[Picture], references: Sequence[Reference]) -> tuple[list[Picture], list[Omitted]]:
    """The photographs that are no references yet, under ids that the scene has not, and those that are."""
    names = {it.reference_id for it in references}
    stored = {it.image_sha256: it.reference_id for it in references}
    new, there = [], []
    for picture in pictures:
        reference = stored.get(hashlib.sha256(picture.path.read_bytes()).hexdigest())
        if reference is not None:
            there.append(Omitted(picture.name, f"{ALREADY}, as reference {reference}"))
            continue
        name = legal_id(picture.name, names)
        names.add(name)
        new.append(replace(picture, name=name))
    return new, there


ALREADY = "it is in the scene already"


def _similar(
    client: Client,
    scene: str,
    new: Sequence[Picture],
    surveyed: Sequence[Reference],
    options: ExtendOptions,
    progress: Progress,
) -> tuple[frozenset[str], dict[str, frozenset[str]]]:
    """The surveyed references of a scene to use, and in a large one those of each photograph."""
    ids = frozenset(it.reference_id for it in surveyed)
    if len(ids) + len(new) <= options.reconstruct.pairs.all_below:
        return ids, {}
    cameras = {name: it.camera for it in starting_cameras(new, options.reconstruct.lens) for name in it.names}
    alike = {}
    for it in tracked("similar references", new, len(new), progress):
        found = client.retrieve_references(it.path, cameras[it.name], scene, options.similar)
        alike[it.name] = ids & {reference.name.rpartition("/")[2] for reference in found}
    return frozenset[str]().union(*alike.values()), alike


def placed_among(
    found: Sequence[KnownPicture],
    new: Sequence[Picture],
    alike: Mapping[str, frozenset[str]],
    work: Path,
    options: ExtendOptions,
    progress: Progress,
) -> Placement:
    """Places new photographs among references, whose poses are fixed.

    In a large scene, each is compared with the references that `alike` has for it. What takes long is kept in `work`.
    """
    cameras = _reference_cameras(found)
    for it in starting_cameras(new, options.reconstruct.lens):
        cameras += _apart(_known_by_exif(it, new, found), new)
    pictures = [*(it.picture for it in found), *new]
    choose = partial(pairs_with_references, count=len(found), alike=alike) if alike else pairs_of
    first = gather(pictures, options.reconstruct, work, progress, choose=choose)
    placement = _of_evidence(found, pictures, cameras, (first,), work, options, progress)
    if options.reconstruct.features == AUTO and first.kind != ANY_ROLL and len(placement.placed) < len(new):
        # Learned features match what is upright; some photographs may be rolled against the references.
        rolled = replace(options.reconstruct, features=ANY_ROLL)
        done = {it.name for it in placement.placed}
        further = gather(pictures, rolled, work, labelled(progress, ANY_ROLL), done, choose)
        placement = _of_evidence(found, pictures, cameras, (first, further), work, options, progress)
    return placement


def _of_evidence(
    found: Sequence[KnownPicture],
    pictures: Sequence[Picture],
    cameras: Sequence[StartingCamera],
    evidence: tuple[Evidence, ...],
    work: Path,
    options: ExtendOptions,
    progress: Progress,
) -> Placement:
    """The result of some kinds of features."""
    database = database_of(pictures, cameras, evidence, work, progress)
    numbers = frozenset(number for number, it in enumerate(cameras, 1) if it.is_known)
    fixed = Fixed({it.picture.name: it.world_from_camera for it in found}, numbers)
    poses = hashlib.sha256(repr([it.world_from_camera.matrix().tolist() for it in found]).encode()).hexdigest()[:16]
    model = work / f"extended-{database.name}-{poses}"
    with made_once(model) as made:
        if made is not None:
            build_model(database, fixed, made, available_cores(), progress)
    provenances = {it.picture.name: it.provenance for it in found}
    return place(database, read_model(model), fixed, provenances, options, available_cores(), progress)


def _reference_cameras(found: Sequence[KnownPicture]) -> list[StartingCamera]:
    """A camera for each reference, since some are placed as if theirs was not known."""
    return [StartingCamera(it.camera, (it.picture.name,), "that of the reference", True, True) for it in found]


def _apart(start: StartingCamera, new: Sequence[Picture]) -> list[StartingCamera]:
    """A camera for each photograph, unless it is known, or EXIF or a video says that they were taken with one.

    Equal sizes alone do not: photographs that were zoomed, cropped or undistorted have them, too.
    """
    first = next(it for it in new if it.name in start.names)
    if start.is_known or first.exif.optics or first.time is not None:
        return [start]
    return [replace(start, names=(name,)) for name in start.names]


def _known_by_exif(start: StartingCamera, new: Sequence[Picture], found: Sequence[KnownPicture]) -> StartingCamera:
    """The camera of references whose EXIF names the same lens and focal length, if they have one; else as it was."""
    if start.is_known:
        return start
    width_px, height_px = start.camera.width_px, start.camera.height_px
    optics = next(it.exif.optics for it in new if it.name in start.names)
    same = [it.camera for it in found if optics and it.picture.exif.optics == optics]
    fitting = [it for it in same if abs(it.width_px * height_px - width_px * it.height_px) <= it.width_px]
    cameras = sorted((it.resized(width_px, height_px) for it in fitting), key=lambda it: it.focal_x_px)
    usual = IntrinsicsSigma().focal_share
    if not cameras or cameras[-1].focal_x_px > (1 + 2 * usual) * cameras[0].focal_x_px:
        return start
    middle = cameras[len(cameras) // 2]
    return replace(start, camera=middle, origin="that of references, by EXIF", has_focal=True, is_known=True)


def store(
    client: Client, extension: Extension, references: Sequence[Reference], source: str, progress: Progress
) -> ImportReport:
    """Stores the photographs that were placed; the report says what was stored, and why it ended early."""
    frames = [_frame(extension.pictures[it.name], it) for it in extension.placement.placed]
    scene = extension.scene
    dataset = Dataset(scene.scene_id, tuple(frames), not scene.arbitrary_unit, source)
    report = ImportReport(scene.scene_id, dataset, frames)
    Uploader(client, KnownReferences(references), report, 1, progress).run()
    return report


def _frame(picture: Picture, placed: Placed) -> Frame:
    provenance = Provenance(PLACED, placed.accuracy)
    return Frame(placed.name, picture.path, placed.camera, placed.world_from_camera, provenance=provenance)
