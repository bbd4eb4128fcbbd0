"""The camera of a photograph that came without intrinsics: chosen before its pose, by EXIF and by its matches."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from mapless.geometry import Camera
from mapless_server.engine.search import Material, Search
from mapless_server.images.exif import focal_of
from mapless_server.method.bundle.intrinsics import read_as
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.options import ChosenCamera, IntrinsicsSource
from mapless_server.method.pipeline import Prepared
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.method.unknown_camera import UNKNOWN, camera_of_references, choose_camera

from .query import Photo

CAMERA = "camera"
"""The stage of choosing the camera of a photograph without intrinsics."""


def with_camera(search: Search, prepared: Prepared) -> Material | Rejection:
    """The search's material with the photograph as read with the camera that its matches speak for.

    `prepared` is the photograph as a pinhole's, matched. A rejection if neither EXIF nor matches show its focal length.
    """
    photo, material = search.query.photo, search.material
    assert material is not None
    assert material.query_matches is not None
    raw = read_as(prepared.query, prepared.query.camera.pinhole())  # with keypoints as the image shows them
    width_px, height_px = raw.camera.width_px, raw.camera.height_px
    guesses = [
        replace(it, camera=it.camera.resized(width_px, height_px)) for it in known_cameras(photo, prepared.references)
    ]
    with search.context.stage(CAMERA):
        found = choose_camera(raw, prepared.references, prepared.correspondences, guesses)
    if found is None:
        return _unknown(len(prepared.references))
    sent = found.camera.resized(photo.camera.width_px, photo.camera.height_px)
    view, matches = _seen(read_as(raw, found.camera), material.query_matches)
    view = replace(view, photograph=view.photograph and replace(view.photograph, camera=sent))
    return replace(material, view=view, query_matches=matches, camera=replace(found, camera=sent))


def known_cameras(photo: Photo, references: Sequence[PosedView]) -> Iterator[ChosenCamera]:
    """The cameras that EXIF knows of a photograph without intrinsics, the likeliest first."""
    assert photo.exif is not None
    if optics := photo.exif.optics:
        same = [it for it in references if it.view.photograph and it.view.photograph.read_exif().optics == optics]
        if camera := camera_of_references(photo.camera, same):
            yield camera
    width_px, height_px = photo.camera.width_px, photo.camera.height_px
    with suppress(ValueError):  # of a part of a photograph EXIF says nothing
        focal = focal_of(photo.exif, width_px, height_px)
        if focal is not None:
            sigma = replace(UNKNOWN, focal_share=min(UNKNOWN.focal_share, focal.sigma_px / focal.focal_px))
            yield ChosenCamera(Camera.centred(width_px, height_px, focal.focal_px), sigma, IntrinsicsSource.EXIF)


def _seen(view: View, query_matches: Sequence[Matches]) -> tuple[View, tuple[Matches, ...]]:
    """The view without keypoints that have no ideal pixel through its lens, and its matches with each reference."""
    seen = np.asarray(np.isfinite(view.features.keypoints).all(axis=1))
    if seen.all():
        return view, tuple(query_matches)
    features, row = view.features, np.cumsum(seen) - 1
    kept = Features(features.keypoints[seen], features.descriptors[seen], features.sizes_px[seen])
    matches = [it[seen[it[:, 0]]] for it in query_matches]
    renumbered = tuple(np.stack([row[it[:, 0]], it[:, 1]], axis=1).astype(np.int32) for it in matches)
    return replace(view, features=kept), renumbered


def _unknown(reference_count: int) -> Rejection:
    if reference_count < 2:
        message = (
            "the photograph has no intrinsics, its EXIF has no focal length, and it is compared with one reference: "
            "two are needed to find it"
        )
        advice = "Send the photograph's intrinsics, or the file with its EXIF; or use two references or more."
        hint = Hint(CAMERA, Advice.CHECK_CALIBRATION, advice)
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, message, hint)
    message = "no pose of a camera of any focal length explains the matches with the references"
    return Rejection(RejectionReason.LOW_OVERLAP, message)
