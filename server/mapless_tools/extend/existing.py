"""The references of a scene, on the disk, as photographs whose cameras and poses are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mapless import Client, Reference
from mapless.geometry import Camera, RigidTransform
from mapless.provenance import ADOPTED, UNKNOWN, Provenance
from mapless_server.images.exif import read_exif
from mapless_tools.ingest.fetching import fetch_all
from mapless_tools.ingest.formats.writing import image_name
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress
from mapless_tools.reconstruct.pictures import Picture

FEWEST_REFERENCES = 2
"""Against one alone nothing says how far anything is."""


@dataclass(frozen=True, eq=False)
class KnownPicture:
    """A reference: its photograph, which is named by its id, with its camera and pose, and how the pose is known."""

    picture: Picture
    camera: Camera
    world_from_camera: RigidTransform
    provenance: Provenance


def check_scene(scene: str, references: Sequence[Reference]) -> None:
    """Raises ValueError if nothing can be placed among these references of a scene, or they would not keep how."""
    if len(references) < FEWEST_REFERENCES:
        count = "one reference" if references else "no references"
        raise ValueError(
            f"scene {scene} has {count}: from fewer than {FEWEST_REFERENCES}, at different places, nothing says how "
            "far anything is; import photographs with poses first"
        )
    if any(it.provenance.source == UNKNOWN for it in references):
        raise ValueError(
            "the server is older than 0.4: it keeps neither that poses are placed nor their accuracy; upgrade it first"
        )


def surveyed_of(references: Sequence[Reference]) -> list[Reference]:
    """The references that were not adopted: what is placed by these may vouch for adopted ones itself."""
    return [it for it in references if it.provenance.source != ADOPTED]


def fetch_references(
    client: Client, scene: str, folder: Path, wanted: frozenset[str], progress: Progress
) -> tuple[list[KnownPicture], dict[str, str]]:
    """Writes the photographs and masks of the references with these ids into a folder.

    Also returns the server's messages about damaged ones, by their ids.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def take(it: Reference) -> KnownPicture:
        image = it.image or b""
        file, mask = folder / image_name(it.reference_id, image), None
        with whole_file(file) as partial:
            partial.write_bytes(image)
        if it.mask is not None:
            mask = folder / f"{file.name}.mask.png"
            with whole_file(mask) as partial:
                partial.write_bytes(it.mask)
        size = it.camera.width_px, it.camera.height_px
        picture = Picture(it.reference_id, file, *size, file, read_exif(image), mask_path=mask)
        return KnownPicture(picture, it.camera, it.world_from_camera, it.provenance)

    return fetch_all(client, scene, take, progress, wanted=wanted)
