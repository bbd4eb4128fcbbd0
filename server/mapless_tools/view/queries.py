"""A query as the viewer shows it."""

from __future__ import annotations

from dataclasses import dataclass

from mapless.answers import LocalizationResult, Rejected
from mapless.geometry import Camera, RigidTransform


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph, its camera, and what was answered; numbered as they come."""

    number: int
    image: bytes
    camera: Camera
    answer: LocalizationResult | Rejected

    @property
    def pose(self) -> RigidTransform | None:
        """The answered pose; None for a rejection."""
        return self.answer.world_from_camera if isinstance(self.answer, LocalizationResult) else None

    @property
    def label(self) -> str:
        """One line for a list."""
        if isinstance(self.answer, Rejected):
            return f"#{self.number} not localized: {self.answer.reason.lower().replace('_', ' ')}"
        radius = self.answer.accuracy
        return f"#{self.number} localized" + (f" to {_length(radius.position_95_m)}" if radius is not None else "")

    def details(self) -> str:
        """All details as Markdown; text from other sources is in code spans, where nothing is marked up."""
        answer, used = self.answer, self.answer.diagnostics
        lines = []
        if isinstance(answer, Rejected):
            lines.append(f"**Not localized**: {_code(answer.message)}")
            if answer.hint is not None:
                lines.append(f"**What helps:** {_code(answer.hint.message)}")
        else:
            if answer.accuracy is not None:
                by = answer.accuracy.calibrated_by
                of = f"calibrated {by}" if by else "not calibrated in this scene"
                radii = f"{_length(answer.accuracy.position_95_m)} and {answer.accuracy.rotation_95_deg:.2f}°"
                lines.append(f"**95 % within** {radii} ({of})")
            if answer.trust is not None:
                lines.append(f"**Trust** {answer.trust:.2f}")
            lines.append(f"**Matches** {answer.inlier_count} of {answer.match_count} agree with the pose")
            x, y, z = answer.world_from_camera.translation
            lines.append(f"**Position** {x:.3f}, {y:.3f}, {z:.3f} m")
            if answer.arbitrary_unit:
                lines.append("**Unit** arbitrary: lengths are not in metres")
            lines += [
                f"**Prior contradicts:** {_code(it.kind.lower())}, at Mahalanobis distance {it.mahalanobis:.1f}"
                for it in answer.prior_checks
                if it.conflict
            ]
        best = sorted(used.references, key=lambda it: -it.inlier_count)[:4]
        if best:
            named = ", ".join(f"{_code(it.name.rpartition('/')[2])} {it.inlier_count}" for it in best)
            lines.append(f"**Inliers by reference** {named}")
        lines.append(f"**Time** {1000 * used.total_s:.0f} ms, request {_code(used.request_id)}")
        return "\n\n".join(lines)


def _code(text: str) -> str:
    """Text in a code span, which is not read as Markdown."""
    shown = " ".join(text.replace("`", "'").split())
    return f"`{shown}`" if shown else ""


def _length(metres: float) -> str:
    return (
        f"{metres:.2f} m" if metres >= 1 else f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
    )
