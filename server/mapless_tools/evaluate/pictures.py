"""Pictures of the worst queries: the photograph beside its best reference, with their matches.

A match is green if it fits the true poses, else red. Only red ones: the matches are wrong. Green ones and a wrong pose:
the error is after matching. None: the two photographs do not overlap.
"""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, cross_matrix
from mapless_server.images import decode_image
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.views import View
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

from .metrics import QueryResult
from .references import Matcher
from .suite import Run, Suite

HEIGHT_PX, GAP_PX = 260, 6
EPIPOLAR_PX = 4.0
"""A match farther from the epipolar line of the true poses is wrong; in pixels of the processed query."""
MAX_DRAWN = 60
QUALITY = 72
Picture = NDArray[np.uint8]
GREEN, RED = (40, 200, 90), (230, 60, 50)


@dataclass(frozen=True)
class WorstQuery:
    """A query and its picture, beside a reference if there is one; `fitting` of their matches fit the true poses."""

    run: Run
    result: QueryResult
    data_uri: str
    reference: str
    matches: int
    fitting: int

    @property
    def caption(self) -> str:
        """The scene, the query, its errors or its rejection, and how many matches fit."""
        run, result = self.run, self.result
        name = f"{run.scene.place.name}, {run.label}: {result.name}"
        if result.localized:
            outcome = (
                f"{100 * result.translation_error:.1f} cm, {result.rotation_error_deg:.2f}° off; "
                f"{result.inlier_count} inliers of {result.match_count} matches with all references"
            )
            if result.accuracy is not None:
                outcome += f"; claimed within {100 * result.accuracy.position_68_m:.1f} cm (68 %)"
        else:
            outcome = f"not localized, {result.rejection}: {result.message}"
        if not self.reference:
            return f"{name}. {outcome}"
        return (
            f"{name}. {outcome}. beside {self.reference}: {self.fitting} of {self.matches} matches fit the true poses"
        )


def worst_queries(suite: Suite, count: int, matcher: Matcher, progress: Progress) -> list[WorstQuery]:
    """The worst queries of each scene, by its first method in the densest and in the sparsest setting."""
    method = suite.options.methods()[0]
    runs: list[Run] = []
    for scene in suite.scenes:
        own = [run for run in suite.runs if run.scene is scene and run.method == method]
        runs += [*own[:1], *own[1:][-1:]]
    worst = []
    for done, run in enumerate(runs if count else ()):
        progress("pictures", done, len(runs))
        worst += worst_of(run, count, matcher)
    return worst


def worst_of(run: Run, count: int, matcher: Matcher) -> list[WorstQuery]:
    """The queries with the largest translation errors, rejected ones first, each with its picture."""
    order = sorted(run.results, key=lambda it: (-it.translation_error, -it.rotation_error_deg, it.name))
    frames = {frame.name: frame for frame in (*run.split.references, *run.split.queries)}
    worst = []
    for result in order[:count]:
        beside = result.best_reference or next(iter(result.references), "")
        query = _Shown.of(frames[result.name], matcher)
        if not beside:
            worst.append(WorstQuery(run, result, data_uri(query.image), "", 0, 0))
            continue
        reference = _Shown.of(frames[beside], matcher)
        matches = mutual_matches(query.view.features, reference.view.features, matcher.ratio)
        fits = fit_true_poses(query.frame, reference.frame, query.view, reference.view, matches)
        picture = _side_by_side(query, reference, matches, fits)
        worst.append(WorstQuery(run, result, data_uri(picture), beside, len(matches), int(fits.sum())))
    return worst


def fit_true_poses(
    query: Frame, reference: Frame, query_view: View, reference_view: View, matches: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Mask (M,) of the matches (M, 2) of query and reference within `EPIPOLAR_PX` of the true epipolar line."""
    query_from_reference = query.world_from_camera.inverse().compose(reference.world_from_camera)
    essential = cross_matrix(query_from_reference.translation) @ query_from_reference.rotation
    x_query = query_view.camera.rays(query_view.features.keypoints[matches[:, 0]])
    x_reference = reference_view.camera.rays(reference_view.features.keypoints[matches[:, 1]])
    lines = x_reference @ essential.T
    distance = np.abs((x_query * lines).sum(axis=1)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    return np.asarray(distance * query_view.camera.focal_x_px <= EPIPOLAR_PX)


def data_uri(picture: Picture) -> str:
    """The picture (H, W, 3) RGB as a JPEG in a data URI."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), quality)[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


@dataclass(frozen=True, eq=False)
class _Shown:
    """A photograph, reduced for the page, with its features.

    Keypoints (N, 2) in pixels of `image`, distorted as it is.
    """

    frame: Frame
    view: View
    image: Picture
    keypoints: Array

    @staticmethod
    def of(frame: Frame, matcher: Matcher) -> "_Shown":
        image = decode_image(frame.image_path.read_bytes(), matcher.limits)
        view = matcher.extractor.extract(image, frame.camera, frame.read_ignored())
        scale = HEIGHT_PX / image.shape[0]
        size = (round(image.shape[1] * scale), HEIGHT_PX)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        pixels = frame.camera.project(view.camera.rays(view.features.keypoints))
        return _Shown(frame, view, np.asarray(small, np.uint8), pixels * scale)


def _side_by_side(query: _Shown, reference: _Shown, matches: NDArray[np.int32], fits: NDArray[np.bool_]) -> Picture:
    gap: Picture = np.full((HEIGHT_PX, GAP_PX, 3), 128, np.uint8)
    canvas = np.ascontiguousarray(np.concatenate([query.image, gap, reference.image], axis=1))
    offset = np.array([query.image.shape[1] + GAP_PX, 0])
    for i in np.linspace(0, len(matches) - 1, min(len(matches), MAX_DRAWN)).round().astype(int).tolist():
        a, b = query.keypoints[matches[i, 0]], reference.keypoints[matches[i, 1]] + offset
        colour = GREEN if fits[i] else RED
        cv2.line(canvas, _pixel(a), _pixel(b), colour, 1, cv2.LINE_AA)
        for end in (a, b):
            cv2.circle(canvas, _pixel(end), 2, colour, -1, cv2.LINE_AA)
    return canvas


def _pixel(place: Array) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))
