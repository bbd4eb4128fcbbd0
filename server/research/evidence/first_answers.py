"""Radii of the first answers in a scene: by the nearest references, generic and by the scene's first calibration.

Some photographs of each place, evenly spread, are its scene. Each is localized by those nearest to it, and some of the
ten nearest against one another, as a first calibration does, without the photograph itself.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from mapless.geometry import rotation_angle_deg
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.dispersion import UncertaintyOptions
from mapless_server.method.bundle.estimate import SELF_TAIL_95, Accuracy
from mapless_server.method.features.views import PosedView
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.scenes.calibration.calibrator import FIRST_SAMPLE, left_out
from mapless_server.scenes.calibration.fit import FitOptions, LeftOut, fit
from mapless_server.serve.features import make_tiers
from mapless_server.services.messages.radii import Conditions, Factors, calibration_of, scaled_accuracy
from mapless_server.settings import load_settings
from research.places import OFFICE, ONE_PLACE, SHORT, Scenes, spread

from .page import Measurement, Row

PHOTOGRAPHS, QUERIES = 16, 8
"""Numbers for each place; of the office all are asked."""
NEAREST = (2, 3, 10)
TURN_DEG = 15.0
"""A reference that looks so far elsewhere counts as twice as far away."""
FREEDOMS = (0.0, 1.0, 2.0, 4.0)
FACTORS, NOISES, TAILS = (0.3, 0.4, 0.5, 0.7), (0.3, 0.6, 0.9, 1.3), (1.1, 1.2, 1.3, 1.4)
NORMAL_68 = 0.468
ANY = Conditions("", "", "BEST", "")


@dataclass(frozen=True, eq=False)
class Asked:
    """A photograph's answer by so many nearest references, and the answers to some of its ten nearest ones."""

    place: str
    photograph: int
    count: int
    answer: LeftOut
    first: tuple[LeftOut, ...] = ()


@dataclass(frozen=True, eq=False)
class PlaceAnswers:
    """Localizes photographs of one place against one another by the first features of the server's settings."""

    name: str
    views: Sequence[PosedView]
    pipeline: Pipeline

    def nearest(self, index: int) -> list[int]:
        """The other photographs, the one with the most similar viewpoint first."""
        own = self.views[index].world_from_camera

        def unlikeness(other: int) -> float:
            pose = self.views[other].world_from_camera
            turned = rotation_angle_deg(own.rotation.T @ pose.rotation) / TURN_DEG
            return float(np.linalg.norm(own.translation - pose.translation) * (1 + turned))

        return sorted((it for it in range(len(self.views)) if it != index), key=unlikeness)

    def answer(self, index: int, references: Sequence[int], freedom: float, coverage: float = 0.95) -> LeftOut | None:
        """The right answer to a photograph by some references; None if it is rejected or wrong."""
        adjust = self.pipeline.options.adjust
        uncertainty = replace(adjust.uncertainty, modelled_freedom=freedom)
        options = replace(self.pipeline.options, adjust=replace(adjust, uncertainty=uncertainty))
        subject = self.views[index]
        chosen = [self.views[it] for it in references]
        pipeline = replace(self.pipeline, options=options)
        found = left_out(subject, localize(subject.view, chosen, pipeline, LocalizeOptions(coverage=coverage)))
        return found if found is not None and found.is_right else None

    def asked(self, freedom: float, is_calibrated: bool) -> Iterator[Asked]:
        """The answers to some photographs by their nearest references."""
        count = len(self.views) if self.name == OFFICE else min(QUERIES, len(self.views))
        for index in np.linspace(0, len(self.views) - 1, count).round().astype(int).tolist():
            order, first = self.nearest(index), list[LeftOut]()
            if is_calibrated:
                group = order[: max(NEAREST)]
                others = (self.answer(it, [x for x in group if x != it], freedom, 1.0) for it in group[:FIRST_SAMPLE])
                first = [it for it in others if it is not None]
            for k in NEAREST:
                answer = self.answer(index, order[:k], freedom)
                if answer is not None:
                    yield Asked(self.name, index, k, answer, tuple(first))


def _places(folder: Path) -> Iterator[PlaceAnswers]:
    scenes, tier = Scenes(folder), make_tiers(load_settings({}).settings)[0]
    for name in scenes.names:
        if name.startswith("video/"):  # single photographs of phones
            continue
        frames = spread(scenes.dataset(name).frames, PHOTOGRAPHS)
        images = (decode_image(it.image_path.read_bytes(), ImageLimits()) for it in frames)
        views = [tier.extractor.extract(image, it.camera) for image, it in zip(images, frames, strict=True)]
        named = [
            PosedView(f"{name}/{it.name}", it.name, view, it.world_from_camera)
            for view, it in zip(views, frames, strict=True)
        ]
        yield PlaceAnswers(name, named, tier.pipeline)


def held(errors: Sequence[float], radii: Sequence[float]) -> str:
    """Per cent of errors within radii, with the interval of 95 % (Wilson)."""
    n, share, z = len(errors), float(np.mean(np.asarray(errors) <= np.asarray(radii))), 1.96
    middle, half = share + z**2 / (2 * n), z * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    low, high = (abs(middle + sign * half) / (1 + z**2 / n) for sign in (-1, 1))
    return f"{100 * share:.0f} ({100 * low:.0f} to {100 * high:.0f})"


def _held(asked: Sequence[Asked], radii: Sequence[Accuracy]) -> dict[str, str]:
    metres, degrees = [it.answer.error_m for it in asked], [it.answer.error_deg for it in asked]
    return {
        "positions 68 %": held(metres, [it.position_68_m for it in radii]),
        "95 %": held(metres, [it.position_95_m for it in radii]),
        "angles 68 %": held(degrees, [it.rotation_68_deg for it in radii]),
        "95 % ": held(degrees, [it.rotation_95_deg for it in radii]),
    }


def few_references(folder: Path) -> Iterator[Row]:
    """For each worth of the modelled covariance: radii that hold, and how often two references claim less than ten."""
    found = {freedom: list[Asked]() for freedom in FREEDOMS}
    for place in _places(folder):
        for freedom in FREEDOMS:
            found[freedom] += place.asked(freedom, is_calibrated=False)
    for freedom, asked in found.items():
        by_count = {k: [it for it in asked if it.count == k] for k in NEAREST}
        claims = {(it.place, it.photograph, it.count): it.answer.claimed.position_68_m for it in asked}
        pairs = [(claims[x, i, 2], r) for (x, i, k), r in claims.items() if k == max(NEAREST) and (x, i, 2) in claims]
        less = np.array([few / many for few, many in pairs])
        inside = {
            f"{k}: positions 68 %": held(
                [it.answer.error_m for it in some], [it.answer.claimed.position_68_m for it in some]
            )
            for k, some in by_count.items()
        }
        yield {
            "worth, references": f"{freedom:g}",
            "answers": len(asked),
            **inside,
            "scatter of ln(error / radius), 2": f"{_scatter(by_count[2]):.2f}",
            "2 claims less than 10": f"{100 * np.mean(less < 1):.0f} %",
            "less than 0.8 of it": f"{100 * np.mean(less < 0.8):.0f} %",
        }


def _scatter(asked: Sequence[Asked]) -> float:
    """Standard deviation within places."""
    by_place: dict[str, list[float]] = {}
    for it in asked:
        by_place.setdefault(it.place, []).append(np.log(it.answer.error_m / it.answer.claimed.position_68_m))
    return float(np.sqrt(np.mean([np.var(it) for it in by_place.values() if len(it) > 2])))


def calibrated(asked: Asked, options: FitOptions, tail: float = SELF_TAIL_95) -> Accuracy:
    """The radii by the first calibration; the generic ones where it says nothing."""
    found = fit(asked.first, "", 0, options)
    if not found.answer_count:
        return asked.answer.claimed
    scale = tail / SELF_TAIL_95
    found = replace(found, position_tail=scale * found.position_tail, rotation_tail=scale * found.rotation_tail)
    claimed = asked.answer.claimed
    return scaled_accuracy(claimed, Factors.of(calibration_of(found, ANY), claimed, asked.answer.gap))


def _loss(asked: Sequence[Asked], options: FitOptions) -> float:
    """Negative mean log likelihood of errors by radii, positions and angles."""
    radii = [calibrated(it, options) for it in asked]
    ratios = [
        (it.answer.error_m / own.position_68_m, it.answer.error_deg / own.rotation_68_deg)
        for it, own in zip(asked, radii, strict=True)
    ]
    off = np.log(np.maximum(ratios, 1e-9)) / options.scatter + NORMAL_68
    return float(np.minimum(off**2, 9.0).mean() / 2)


def answers_by_place(folder: Path) -> dict[str, list[Asked]]:
    """The answers in each place, with those of the first calibration."""
    freedom = UncertaintyOptions().modelled_freedom
    found = {it.name: list(it.asked(freedom, is_calibrated=True)) for it in _places(folder)}
    return {name: asked for name, asked in found.items() if asked}


def first_answers(folder: Path) -> Iterator[Row]:
    """How often radii hold, in each place with the priors that the other places decide for."""
    by_place = answers_by_place(folder)
    choices = [FitOptions(factor_log=f, noise_share=s) for f, s in product(FACTORS, NOISES)]
    losses = {name: [_loss(asked, it) for it in choices] for name, asked in by_place.items()}
    everything, after = list[Asked](), list[Accuracy]()
    for name, asked in by_place.items():
        one = next((set(it) for it in ONE_PLACE if name in it), {name})
        mean = np.mean([own for other, own in losses.items() if other not in one], axis=0)
        chosen = choices[int(np.argmin(mean))]
        own = [calibrated(it, chosen) for it in asked]
        everything += asked
        after += own
        groups = [(k, [i for i, it in enumerate(asked) if it.count == k]) for k in NEAREST] if name == OFFICE else []
        short = SHORT.get(name, name)
        for label, indices in [*((f"{short}, {k} nearest", some) for k, some in groups), (short, range(len(asked)))]:
            some = [asked[i] for i in indices]
            yield _row(label, some, [own[i] for i in indices])
    yield _row("all, each left out", everything, after)
    mean = np.mean(list(losses.values()), axis=0)
    for it, loss in zip(choices, mean, strict=True):
        print(f"factor_log {it.factor_log:g}, noise_share {it.noise_share:g}: loss {loss:.4f}", flush=True)
    best = choices[int(np.argmin(mean))]
    for tail in TAILS:
        radii = [calibrated(it, best, tail) for it in everything]
        print(f"tail {tail:g}: {_held(everything, radii)}", flush=True)


def _row(label: str, asked: Sequence[Asked], radii: Sequence[Accuracy]) -> Row:
    generic = {f"generic: {title}": it for title, it in _held(asked, [it.answer.claimed for it in asked]).items()}
    return {"place": label, "answers": len(asked), **generic, **_held(asked, radii)}


MEASUREMENTS = {
    "few-references": Measurement(few_references),
    "first-answers": Measurement(first_answers),
}
