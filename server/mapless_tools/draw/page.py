"""The page of one answer: an HTML file with its pictures in it, which loads nothing and runs no scripts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless import Camera, LocalizationResult, Reference, Rejected
from mapless.answers import POINT_SOURCES
from mapless.diagnostics import Debug
from mapless.lenses import lens_model_of
from mapless.names import reference_name
from mapless_server.errors import InvalidArgument
from mapless_tools.charts import figure_of, inline_svg, new_axes
from mapless_tools.matches import (
    MAX_GOOD,
    MAX_WRONG,
    SOURCE_COLOURS,
    Shot,
    axes_on,
    data_uri,
    draw_matches,
    rendered,
    side_by_side,
    source_colours,
)
from mapless_tools.output_files import render
from mapless_tools.plan import FOUND, OTHER, REFERENCE, Cameras, basis_from_above, down_of, draw_ellipse, draw_plan

Answer = LocalizationResult | Rejected
MAX_PAIRS = 3
"""References that are shown beside the photograph."""
PHOTOGRAPH_PX, REFERENCE_PX = 1600, 960
"""Longer sides of photographs in a page, at most: it has less than 5 MB, which any mailbox accepts."""
_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Figure:
    """A picture, JPEG in a data URI, with its caption; without a picture the caption says why."""

    caption: str
    data_uri: str = ""


@dataclass(frozen=True)
class Table:
    """A table; empty ones are left out."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def answer_page(
    title: str,
    answer: Answer,
    image: bytes,
    camera: Camera,
    references: Sequence[Reference] = (),
    down_in_world: ArrayLike | None = None,
    missing: str = "",
) -> str:
    """The page of an answer, less than 5 MB of HTML.

    Args:
        title: the photograph's name, for example.
        answer: the answer of `localize`; with `debug`, its matches are drawn.
        image: the photograph as it was sent; it is reduced, and its metadata are left out.
        camera: as it was sent.
        references: references of the scene, for the plan; the `best_references` with images are shown.
        down_in_world: direction of gravity in the scene; None to estimate it from the cameras.
        missing: a sentence on references that are left out.
    """
    known = {reference_name(it.scene_id, it.reference_id): it for it in references}
    text = str(answer)
    return render(
        "answer.html",
        title=f"{title}: {text.partition(chr(10))[0]}",
        text=text,
        photograph=_photograph(answer, image, camera),
        hinted=_hinted(answer, known),
        missing=missing,
        pairs=_pairs(answer, image, camera, known),
        svgs=_charts(answer, camera, known, down_in_world),
        tables=[it for it in _tables(answer) if it.rows],
        provenance=_facts(answer, camera),
    )


def best_references(answer: Answer) -> list[str]:
    """Names of the references to show: the hint's, and those with most inliers, then matches."""
    uses = answer.diagnostics.references
    order = sorted((it for it in uses if it.match_count), key=lambda use: (-use.inlier_count, -use.match_count))
    hint = answer.hint if isinstance(answer, Rejected) else None
    hinted = [hint.best_reference] if hint is not None and hint.best_reference else []
    return list(dict.fromkeys([*hinted, *(use.name for use in order[:MAX_PAIRS])]))


def _shot(image: bytes | None, camera: Camera, max_side_px: int) -> Shot | None:
    """None without an image, or if it cannot be read."""
    try:
        return None if image is None else Shot.of(image, camera, max_side_px)
    except InvalidArgument:
        return None


def _photograph(answer: Answer, image: bytes, camera: Camera) -> Figure:
    shot, debug = _shot(image, camera, PHOTOGRAPH_PX), answer.debug
    if shot is None:
        return Figure("The photograph cannot be read, and is left out.")
    if debug is None:
        return Figure("The answer includes no matches: `mapless localize --debug` does.", data_uri(shot.image))
    axes = axes_on(shot.image)
    good, projected, count = debug.is_inlier, None, f"{len(debug.is_inlier)} matches"
    if isinstance(answer, LocalizationResult):
        seen = camera.project(answer.world_from_camera.inverse().apply(debug.x_in_world))
        projected = shot.pixels_of(seen, camera)
    pixels = shot.pixels_of(debug.query_px, camera)
    factor = draw_matches(axes, pixels, projected, good, colours=source_colours(debug))
    caption = f"{count}: dots agree with the pose ({good.sum()}), crosses do not ({(~good).sum()})."
    if projected is None:
        caption = f"{count}, no pose was accepted."
    elif factor > 1:
        caption += f" Lines lead to the projections of their points, those of dots drawn {factor} times as long."
    if sources := [f"{count} {_source(it)}" for it, count in debug.inliers_by_source().items()]:
        caption += f" Of the dots are {'; '.join(sources)}."
    return Figure(caption, data_uri(rendered(axes.figure)))


def _hinted(answer: Answer, references: Mapping[str, Reference]) -> Figure | None:
    """The reference that a rejection's hint names."""
    hint = answer.hint if isinstance(answer, Rejected) else None
    reference = references.get(hint.best_reference) if hint is not None else None
    shot = _shot(reference.image, reference.camera, REFERENCE_PX) if reference is not None else None
    if hint is None or reference is None or shot is None:
        return None
    what = "Point the camera at this" if hint.advice == "LOOK_AT_REFERENCE" else "It shares most with the photograph"
    return Figure(f"{what}: {reference.reference_id}", data_uri(shot.image))


def _pairs(answer: Answer, image: bytes, camera: Camera, references: Mapping[str, Reference]) -> list[Figure]:
    """The photograph beside each of the best references, with the matches that each shows best."""
    shot, debug = _shot(image, camera, REFERENCE_PX), answer.debug
    if shot is None or debug is None:
        return []
    figures = []
    by_name = {use.name: (index, use) for index, use in enumerate(answer.diagnostics.references)}
    for name in best_references(answer):
        reference = references.get(name)
        if reference is None or name not in by_name:
            continue
        index, use = by_name[name]
        rows = debug.reference == index
        other = _shot(reference.image, reference.camera, REFERENCE_PX)
        if other is None or not rows.any():
            continue
        ends = shot.pixels_of(debug.query_px[rows], camera), other.pixels_of(debug.reference_px[rows], reference.camera)
        good = debug.is_inlier[rows]
        drawn = min(int(good.sum()), MAX_GOOD) + min(int((~good).sum()), MAX_WRONG)
        caption = (
            f"{reference.reference_id}: {use.inlier_count} inliers on points that it shows, {use.match_count} feature "
            f"matches; drawn are {drawn} of the {len(good)} matches that it shows best"
        )
        colours = np.array(source_colours(debug))[rows].tolist()
        figures.append(Figure(caption, data_uri(side_by_side(shot, other, *ends, good, colours=colours))))
    return figures


def _charts(
    answer: Answer, camera: Camera, references: Mapping[str, Reference], down_in_world: ArrayLike | None
) -> list[str]:
    """The plan, and the ellipse of the position, as SVG."""
    found = (
        [answer.world_from_camera]
        if isinstance(answer, LocalizationResult)
        else [it.world_from_camera for it in answer.hypotheses if it.scene == answer.scene]
    )
    used = {it.name for it in answer.diagnostics.references if it.match_count}
    if not used and not found:
        return []
    poses = [*(it.world_from_camera for it in references.values()), *found]
    if not poses:
        return []
    basis = basis_from_above(down_of(None, poses) if down_in_world is None else down_in_world)
    unit = "units" if isinstance(answer, LocalizationResult) and answer.arbitrary_unit else "m"
    by_use: dict[bool, list[Reference]] = {True: [], False: []}
    for name, it in references.items():
        by_use[name in used].append(it)
    groups = [
        Cameras("other references", OTHER, [(it.world_from_camera, it.camera) for it in by_use[False]]),
        Cameras("references compared", REFERENCE, [(it.world_from_camera, it.camera) for it in by_use[True]]),
        Cameras("the photograph", FOUND, [(it, camera) for it in found], 1.4),
    ]
    axes = new_axes("From above" if len(found) < 2 else "From above: the places it may be", "", "")
    draw_plan(axes, basis, groups, _inlier_points(answer.debug), unit=unit)
    charts = [inline_svg(figure_of(axes))]
    covariance = answer.covariance if isinstance(answer, LocalizationResult) else None
    if covariance is not None and np.isfinite(covariance).all():
        axes = new_axes("95 % of positions, from above", "", "")
        draw_ellipse(axes, basis, covariance, unit)
        charts.append(inline_svg(figure_of(axes)))
    return charts


def _inlier_points(debug: Debug | None) -> NDArray[np.float64]:
    if debug is None:
        return np.empty((0, 3))
    return debug.x_in_world[debug.is_inlier & np.isfinite(debug.x_in_world).all(axis=1)]


def _tables(answer: Answer) -> list[Table]:
    used = answer.diagnostics
    tables = []
    if isinstance(answer, Rejected):
        tables.append(Table("Where it could be", ("x, y, z", "inliers", "supported by", "scene"), _hypotheses(answer)))
    elif answer.covariance is not None:
        sigmas = np.sqrt(np.maximum(np.diag(answer.covariance), 0.0))
        rows = [
            [axis, f"{sigma:.2g}", *(f"{it:.2e}" for it in row)]
            for axis, sigma, row in zip(_AXES, sigmas, answer.covariance, strict=True)
        ]
        title = "Covariance, metres and radians about fixed world axes"
        tables.append(Table(title, ("", "standard deviation", *_AXES), rows))
    references = [
        [it.name.rpartition("/")[2], f"{it.similarity:.2f}", str(it.match_count), str(it.inlier_count)]
        for it in used.references
        if it.match_count or it.similarity
    ]
    head = ("reference", "similarity", "feature matches", "inliers on points that it shows")
    attempts = [
        [it.rung, it.features, it.outcome, f"{it.duration_s:.2f} s", "yes" if it.chosen else ""] for it in used.attempts
    ]
    times = {**used.stage_s, "waiting": used.queue_s, "all": used.total_s}
    return [
        *tables,
        Table("What gives points their distance", ("points", "matches", "inliers"), _sources(answer.debug)),
        Table("References", head, references),
        Table("Attempts", ("attempt", "features", "outcome", "time", "the answer's"), attempts),
        Table("Where the time went", ("stage", "ms"), [[stage, f"{1000 * it:.0f}"] for stage, it in times.items()]),
    ]


def _sources(debug: Debug | None) -> list[list[str]]:
    """Matches and inliers by the source of their points."""
    if debug is None:
        return []
    return [
        [_source(it), str((debug.source == it).sum()), str(inliers)]
        for it, inliers in debug.inliers_by_source().items()
    ]


def _source(name: str) -> str:
    """A source of points, with its colour."""
    return f"{SOURCE_COLOURS[name][0]}, {POINT_SOURCES[name]}" if name in SOURCE_COLOURS else name


def _hypotheses(answer: Rejected) -> list[list[str]]:
    return [
        [
            ", ".join(f"{v:.3f}" for v in it.world_from_camera.translation),
            str(it.inlier_count),
            ", ".join(name.rpartition("/")[2] for name in it.references),
            it.scene.rpartition("/")[2],
        ]
        for it in answer.hypotheses
    ]


def _facts(answer: LocalizationResult | Rejected, camera: Camera) -> dict[str, str]:
    """Software, options and inputs, by name."""
    used = answer.diagnostics
    among = f", found among {used.searched_scene_count}" if used.is_among_several else ""
    lens = "none"
    if camera.distortion is not None:
        values = ", ".join(f"{name} {value:g}" for name, value in vars(camera.distortion).items() if value)
        lens = f"{lens_model_of(camera.distortion)}: {values or 'all zero'}"
    size = f"{camera.width_px} x {camera.height_px}"
    return {
        "features": used.features,
        "backend": used.backend + (f", weights {used.weights_sha256[:12]}" if used.weights_sha256 else ""),
        "variant": used.variant.lower(),
        "references chosen by": used.retrieval or "the caller",
        **({"scene": answer.scene.rpartition("/")[2] + among} if answer.scene else {}),
        "scene's generation": str(used.store_generation),
        "photograph": f"{size}, processed as {used.processed_width_px} x {used.processed_height_px}",
        "focal lengths": f"{camera.focal_x_px:.1f}, {camera.focal_y_px:.1f} px",
        "principal point": f"{camera.principal_x_px:.1f}, {camera.principal_y_px:.1f} px",
        "lens distortion": lens,
        "the photograph's depth": "none" if used.depth_check is None else str(used.depth_check),
        "request": used.request_id,
        "server": f"mapless {used.server_version}",
    }
