"""Sections of text and tables."""

from collections.abc import Sequence

import numpy as np

from ..answers import LocalizationResult, PriorCheck, Rejected
from ..diagnostics import Diagnostics
from ..geometry import Array, Camera, RigidTransform
from ..lenses import lens_model_of
from .markup import UNKNOWN, angle, duration, length, reference_id, section, table, text

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_STAGES = {"REFINED": "refined", "INITIAL": "the reconstruction's own", "COARSE": "coarse, not verified"}


def cards(answer: LocalizationResult | Rejected) -> str:
    """The most important numbers."""
    shown: list[tuple[str, str]] = []
    if isinstance(answer, LocalizationResult):
        if answer.accuracy is not None:
            how = "in 95 % of cases" + ("" if answer.accuracy.calibrated_by else " (uncalibrated)")
            shown.append((length(answer.accuracy.position_95_m), f"position is not further off, {how}"))
            shown.append((angle(answer.accuracy.rotation_95_deg), f"direction is not further off, {how}"))
        if answer.trust is not None:
            shown.append((f"{answer.trust:.2f}", "trust: share of right answers that look no better"))
        shown.append((f"{answer.inlier_count}/{answer.match_count}", "matches agree with the pose"))
    elif answer.debug is not None:
        shown.append((str(len(answer.debug.is_inlier)), "matches with points of the references"))
    compared = sum(use.match_count > 0 for use in answer.diagnostics.references)
    if compared:
        shown.append((str(compared), "references compared"))
    shown.append((duration(answer.diagnostics.total_s), "in the server"))
    return (
        '<div class="cards">'
        + "".join(f'<div class="card"><b>{b}</b><span>{s}</span></div>' for b, s in shown)
        + "</div>"
    )


def notices(answer: LocalizationResult | Rejected) -> str:
    """Advice, conflicts with priors, and whether the call is captured."""
    parts = []
    if answer.diagnostics.captured:
        parts.append('<p class="hint">The server keeps this call for a time, including the photograph.</p>')
    if isinstance(answer, Rejected) and answer.hint is not None:
        hint = answer.hint
        best = f" It shares most with <b>{text(reference_id(hint.best_reference))}</b>." if hint.best_reference else ""
        stage = f' <span class="note">(stage: {text(hint.stage)})</span>' if hint.stage else ""
        parts.append(f'<p class="hint"><b>What helps.</b> {text(hint.message)}{best}{stage}</p>')
    if isinstance(answer, LocalizationResult):
        if answer.arbitrary_unit:
            parts.append(
                '<p class="hint conflict">The unit of length of this scene is arbitrary: where lengths say metres, '
                "they are in that unit.</p>"
            )
        if answer.pose_stage == "COARSE":
            parts.append('<p class="hint conflict">This pose is not verified: there was no time to refine it.</p>')
        parts += [
            f'<p class="hint conflict">The {text(check.kind.lower())} prior contradicts '
            f"the photograph{'' if check.used else ', and was not used'}.</p>"
            for check in answer.prior_checks
            if check.conflict
        ]
    return "".join(parts)


def pose_section(answer: LocalizationResult) -> str:
    """The pose in all requested forms."""
    rows = [*_pose_rows(answer.world_from_camera)]
    rows.append(["which stage gave it", text(_STAGES.get(answer.pose_stage, answer.pose_stage.lower()))])
    if answer.geo_pose is not None:
        geo = answer.geo_pose
        rows.append(["on the Earth (WGS84)", f"{geo.lat:.8f}°, {geo.lon:.8f}°, {geo.h:.2f} m above the ellipsoid"])
    if answer.in_axes is not None and answer.in_axes.axes not in ("OPENCV", ""):
        rows += [
            [f"{text(answer.in_axes.axes)} axes: {name}", value]
            for name, value in _pose_rows(answer.in_axes.world_from_camera)
        ]
    if answer.world_from_session is not None:
        rows += [[f"world_from_session: {name}", value] for name, value in _pose_rows(answer.world_from_session)]
    return section("Pose: world_from_camera", table((), rows, "words"))


def accuracy_section(answer: LocalizationResult) -> str:
    """Radii, standard deviations and the covariance."""
    parts = []
    accuracy = answer.accuracy
    if accuracy is not None:
        parts.append(
            table(
                ("not exceeded in", "68 %", "95 %"),
                [
                    ["position", length(accuracy.position_68_m), length(accuracy.position_95_m)],
                    ["direction", angle(accuracy.rotation_68_deg), angle(accuracy.rotation_95_deg)],
                ],
            )
        )
        parts.append(
            '<p class="note">'
            + (
                f"Calibrated in this scene, {accuracy.calibrated_by} with known poses."
                if accuracy.calibrated_by
                else "Not calibrated in this scene."
            )
            + "</p>"
        )
    if answer.covariance is not None:
        parts += [_deviations(answer.covariance), _covariance(answer.covariance)]
    return section("How far it may be off", *parts)


def hypotheses_section(answer: Rejected) -> str:
    """The poses of a rejection: those that contradict each other, or the one that is not precise enough."""
    rows = []
    for letter, it in zip("ABCDEFGH", answer.hypotheses, strict=False):
        t = it.world_from_camera.translation
        named = ", ".join(text(reference_id(name)) for name in it.references)
        radii = (
            "" if it.accuracy is None else f"{it.accuracy.position_95_m:.3g}, {it.accuracy.rotation_95_deg:.2g}&deg;"
        )
        rows.append([letter, ", ".join(f"{v:.3f}" for v in t), radii, str(it.inlier_count), named])
    head = ("", "position, m", "95 % within, m", "inliers", "supported by")
    return section("Where it could be", table(head, rows)) if rows else ""


def priors_section(checks: Sequence[PriorCheck]) -> str:
    """Priors, compared with the answer."""
    rows = [
        [
            text(it.kind.lower()),
            f"{it.mahalanobis:.2f}",
            str(it.degrees_of_freedom),
            '<span class="conflict-mark">contradicts</span>' if it.conflict else '<span class="ok">agrees</span>',
            "yes" if it.used else "no",
        ]
        for it in checks
    ]
    head = ("prior", "Mahalanobis distance", "degrees of freedom", "with the photograph", "used")
    return section("Priors", table(head, rows)) if rows else ""


def references_section(diagnostics: Diagnostics) -> str:
    """Contribution of each reference; empty if none has matches or a similarity."""
    if not any(it.match_count or it.similarity for it in diagnostics.references):
        return ""
    most = max((it.match_count for it in diagnostics.references), default=0) or 1
    rows = []
    for it in diagnostics.references:
        bars = (
            f'<span class="bar good" style="width:{100 * it.inlier_count / max(most, it.inlier_count):.0f}px"></span>'
        )
        similarity = f"{it.similarity:.2f}" if it.similarity else UNKNOWN
        rows.append([text(reference_id(it.name)), similarity, str(it.match_count), str(it.inlier_count), bars])
    head = ("reference", "similarity", "feature matches", "inliers it shows", "")
    return section("References", table(head, rows, "names")) if rows else ""


def timings_section(diagnostics: Diagnostics) -> str:
    """Time by stage."""
    total = max([*diagnostics.stage_s.values(), 1e-9])
    rows = [
        [text(stage), duration(spent), f'<span class="bar" style="width:{120 * spent / total:.0f}px"></span>']
        for stage, spent in diagnostics.stage_s.items()
    ]
    rows.append(["waiting", duration(diagnostics.queue_s), ""])
    rows.append(["<b>all</b>", f"<b>{duration(diagnostics.total_s)}</b>", ""])
    return section("Where the time went", table(("stage", "", ""), rows))


def provenance_section(diagnostics: Diagnostics, camera: Camera) -> str:
    """Software, options and inputs."""
    d = diagnostics
    lens = "none"
    if camera.distortion is not None:
        values = ", ".join(f"{name} {value:g}" for name, value in vars(camera.distortion).items() if value)
        lens = f"{lens_model_of(camera.distortion)}: {values or 'all zero'}"
    rows = [
        ["features", d.features],
        ["backend", d.backend + (f", weights {d.weights_sha256[:12]}…" if d.weights_sha256 else "")],
        ["variant", d.variant.lower()],
        ["references chosen by", d.retrieval or "the caller"],
        ["scene's generation", str(d.store_generation)],
        [
            "photograph",
            f"{camera.width_px} x {camera.height_px}, processed as {d.processed_width_px} x {d.processed_height_px}",
        ],
        [
            "focal lengths, principal point",
            f"{camera.focal_x_px:.1f}, {camera.focal_y_px:.1f}; "
            f"{camera.principal_x_px:.1f}, {camera.principal_y_px:.1f} px",
        ],
        ["lens distortion", lens],
        ["request", d.request_id],
        ["server", f"mapless {d.server_version}"],
    ]
    if d.scale is not None:
        by = f"by {d.scale.stage.lower()}, deviation {100 * d.scale.deviation:.2f} %"
        scale = f"{d.scale.metres_per_unit:.4g} m a unit, {by}"
        rows.insert(3, ["scale", scale])
    return section("What computed it", table((), [[text(a), text(b)] for a, b in rows], "words"))


def _pose_rows(pose: RigidTransform) -> list[list[str]]:
    q = pose.quaternion()
    return [
        ["position, m", ", ".join(f"{v:.4f}" for v in pose.translation)],
        ["quaternion x, y, z, w", f"{q.x:.6f}, {q.y:.6f}, {q.z:.6f}, {q.w:.6f}"],
    ]


def _deviations(covariance: Array) -> str:
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    cells = [length(v) for v in sigma[:3]] + [angle(v) for v in np.degrees(sigma[3:])]
    return "<h3>Standard deviations along and about the world axes</h3>" + table(_AXES, [cells], "matrix")


def _covariance(covariance: Array) -> str:
    rows = [[f"<b>{name}</b>", *(f"{it:.2e}" for it in row)] for name, row in zip(_AXES, covariance, strict=True)]
    title = "<h3>Covariance, metres and radians, fixed world axes (ROS's order)</h3>"
    return title + table(("", *_AXES), rows, "matrix")
