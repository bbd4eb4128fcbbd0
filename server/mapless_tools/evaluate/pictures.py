"""Pictures of the worst queries: the photograph beside its best reference, with their matches.

A match is green if it fits the true poses, else orange. Only orange ones: the matches are wrong. Green ones and a wrong
pose: the error is after matching. None: the two photographs do not overlap.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, cross_matrix
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.views import View
from mapless_tools.dataset import Frame
from mapless_tools.matches import Shot, data_uri, side_by_side
from mapless_tools.progress import Progress

from .metrics import QueryResult
from .references import Matcher
from .suite import Run, Suite

HEIGHT_PX, MAX_SIDE_PX = 260, 640
EPIPOLAR_PX = 4.0
"""A match farther from the epipolar line of the true poses is wrong; in pixels of the processed query."""


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
            worst.append(WorstQuery(run, result, data_uri(query.shot.image), "", 0, 0))
            continue
        reference = _Shown.of(frames[beside], matcher)
        matches = mutual_matches(query.view.features, reference.view.features, matcher.ratio)
        fits = fit_true_poses(query.frame, reference.frame, query.view, reference.view, matches)
        ends = query.keypoints[matches[:, 0]], reference.keypoints[matches[:, 1]]
        picture = side_by_side(query.shot, reference.shot, *ends, fits, HEIGHT_PX)
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


@dataclass(frozen=True, eq=False)
class _Shown:
    """A photograph, reduced for the page, with its features, and their keypoints (N, 2) in its pixels."""

    frame: Frame
    view: View
    shot: Shot
    keypoints: Array

    @staticmethod
    def of(frame: Frame, matcher: Matcher) -> "_Shown":
        data = frame.image_path.read_bytes()
        view = frame.described(matcher.extractor, matcher.limits)
        pixels = frame.camera.project(view.camera.rays(view.features.keypoints))
        shot = Shot.of(data, frame.camera, MAX_SIDE_PX)
        return _Shown(frame, view, shot, shot.pixels_of(pixels, frame.camera))
