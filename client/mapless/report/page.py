"""The report of one answer, composed of its sections."""

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..answers import LocalizationResult, Rejected
from ..geometry import Camera, RigidTransform
from ..results import Reference
from . import sections
from .markup import reference_id, section, text
from .overlay import best_references, define, image_of, overlay, pairs
from .pictures import Picture, picture
from .plan import plan_view

PHOTOGRAPH_BYTES = 1_800_000
REFERENCE_BYTES = 450_000
"""Limits of pictures before their encoding as text, which adds a third: with three references and all drawings a page
has less than 5 MB, which any mailbox accepts."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""Permits no external resources and no scripts."""


def report_html(
    answer: LocalizationResult | Rejected,
    image: bytes,
    camera: Camera,
    references: Sequence[Reference] = (),
    title: str = "",
    down_in_world: ArrayLike | None = None,
) -> str:
    """The page; see `write_report`."""
    by_name = {f"scenes/{it.scene_id}/references/{it.reference_id}": it for it in references}
    photograph = picture(image, PHOTOGRAPH_BYTES)
    diagnostics = answer.diagnostics
    shown = {_hinted(answer), *best_references(answer.debug, diagnostics.references)} & by_name.keys()
    images = {name: by_name[name].image for name in shown}
    pictures = {name: picture(it, REFERENCE_BYTES) for name, it in images.items() if it is not None}
    if isinstance(answer, LocalizationResult):
        first = [sections.pose_section(answer), sections.accuracy_section(answer)]
        further, whereabouts = [sections.priors_section(answer.prior_checks)], "Where it is"
    else:
        first, further = [], [sections.hypotheses_section(answer)]
        whereabouts = "Where it could be, from above" if answer.hypotheses else "Where the references stand"
    body = [
        _header(answer, title),
        define(photograph, camera),
        _photograph_section(answer, camera, photograph),
        _best_reference(answer, by_name, pictures),
        section("Beside the references", pairs(answer.debug, diagnostics.references, camera, by_name, pictures)),
        section(whereabouts, _plan(answer, by_name, camera, down_in_world)),
        *first,
        *further,
        sections.references_section(diagnostics),
        sections.timings_section(diagnostics),
        sections.provenance_section(diagnostics, camera),
        f"<footer>Written {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC. This page holds the photograph itself and "
        "needs nothing else.</footer>",
    ]
    style = Path(__file__).with_name("style.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{text(_POLICY)}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(_verdict(answer))}{': ' + text(title) if title else ''}</title><style>{style}</style></head>"
        f"<body>{''.join(body)}</body></html>\n"
    )


def _verdict(answer: LocalizationResult | Rejected) -> str:
    return "Localized" if isinstance(answer, LocalizationResult) else "Not localized"


def _header(answer: LocalizationResult | Rejected, title: str) -> str:
    kind = "good" if isinstance(answer, LocalizationResult) else "bad"
    parts = [title] if title else []
    if answer.capture_time is not None:
        parts.append(f"taken {answer.capture_time:%Y-%m-%d %H:%M:%S} UTC")
    why = ""
    headline = f'<span class="{kind}">{_verdict(answer)}</span>'
    if isinstance(answer, Rejected):
        headline += f": {text(answer.reason.replace('_', ' ').lower())}"
        why = f'<p class="why">{text(answer.message)} <span class="note">({text(answer.reason)})</span></p>'
    return (
        f'<header><p class="kicker">{text(" · ".join(parts) or "mapless")}</p><h1>{headline}</h1>{why}'
        f"{sections.cards(answer)}{sections.notices(answer)}</header>"
    )


def _photograph_section(answer: LocalizationResult | Rejected, camera: Camera, photograph: Picture) -> str:
    note = f'<p class="note">{text(photograph.note)}</p>' if photograph.note else ""
    if answer.debug is not None and len(answer.debug.is_inlier):
        pose = answer.world_from_camera if isinstance(answer, LocalizationResult) else None
        return section("The photograph and its matches", note, overlay(answer.debug, camera, pose))
    if answer.debug is not None:
        why = "It has no matches."
    elif "pnp" in answer.diagnostics.stage_s:
        why = "The answer includes no matches: they need include_debug."
    else:
        why = "The computation ended before it was matched with points of the scene."
    shown = f'<svg viewBox="-0.5 -0.5 {camera.width_px} {camera.height_px}"><use href="#photograph"/></svg>'
    return section("The photograph", note, f"<figure>{shown}<figcaption>{why}</figcaption></figure>")


def _best_reference(
    answer: LocalizationResult | Rejected, references: Mapping[str, Reference], pictures: Mapping[str, Picture]
) -> str:
    name = _hinted(answer)
    shown = pictures.get(name)
    if shown is None:
        return ""
    camera = references[name].camera
    is_target = isinstance(answer, Rejected) and answer.hint is not None and answer.hint.advice == "LOOK_AT_REFERENCE"
    figure = (
        f'<figure class="target"><svg viewBox="-0.5 -0.5 {camera.width_px} {camera.height_px}" role="img" '
        f'aria-label="{text(reference_id(name))}">{image_of(shown, camera)}</svg>'
        f"<figcaption><b>{text(reference_id(name))}</b>: of all references, it shares most with the photograph. "
        f"{text(shown.note)}</figcaption></figure>"
    )
    return section("Point the camera at this" if is_target else "What it shares most with", figure)


def _hinted(answer: LocalizationResult | Rejected) -> str:
    """Name of the reference in a rejection's hint; empty if there is none."""
    hint = answer.hint if isinstance(answer, Rejected) else None
    return hint.best_reference if hint is not None else ""


def _plan(
    answer: LocalizationResult | Rejected,
    references: Mapping[str, Reference],
    camera: Camera,
    down_in_world: ArrayLike | None,
) -> str:
    poses: list[tuple[str, RigidTransform]] = []
    covariance, points = None, np.empty((0, 3))
    if isinstance(answer, LocalizationResult):
        poses, covariance = [("the photograph", answer.world_from_camera)], answer.covariance
        if answer.debug is not None:
            points = answer.debug.x_in_world[answer.debug.is_inlier]
    else:
        poses = [(letter, it.world_from_camera) for letter, it in zip("ABCDEFGH", answer.hypotheses, strict=False)]
        if answer.debug is not None:
            points = answer.debug.x_in_world
    used = [use.name for use in answer.diagnostics.references if use.match_count > 0]
    if not used and not poses:
        return ""
    return plan_view(references, used, poses, camera, covariance, points, down_in_world)
