"""The judge's weights and quantiles, from answers that are known to be right or wrong.

    python -m mapless_tools.calibrate.trust_fit FOLDER_OF_SCENES [--samples FILE]

Weights by logistic regression with weights of one sign, so that more evidence never lowers the trust; every scene
counts alike, and so do right and wrong. Quantiles of the natural right answers alone. What comes of it for a scene that
took no part is told too: each scene is left out once, and judged by what the others teach.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from mapless.geometry import Array
from mapless_server.method.trust.evidence import FEATURES, Evidence
from mapless_server.method.trust.judge import LEVELS, JudgeOptions, trust_of

from .trust_samples import Sample, collect

COVERAGES = (0.90, 0.95, 0.99)
RIDGE = 0.005
"""On the squared weights of standardized features; four times as much changes no figure by more than a per cent."""


def fit(samples: Sequence[Sample]) -> JudgeOptions:
    """What the judge is to go by."""
    weights = fit_weights(samples)
    natural = [it for it in samples if it.kind == "natural" and it.right]
    scores = np.array([it.evidence.features() @ weights for it in natural])
    quantiles = np.quantile(scores, LEVELS)
    return JudgeOptions(tuple(np.round(weights, 3).tolist()), tuple(np.round(quantiles, 3).tolist()))


def fit_weights(samples: Sequence[Sample]) -> Array:
    """Weights (7,) of the features, none below 0, that tell right samples from wrong ones best.

    Minimizes the mean of log(1 + exp(-y (w . z + b))) + ridge |w|^2 over standardized features z, y = 1 or -1.
    """
    features = np.stack([it.evidence.features() for it in samples])
    sign = np.where([it.right for it in samples], 1.0, -1.0)
    share = np.zeros(len(samples))
    for side in (1.0, -1.0):
        rows = np.flatnonzero(sign == side).tolist()
        share[rows] = 0.5 * _balance([samples[i].scene for i in rows])
    spread = features.std(axis=0) + 1e-9
    z = (features - features.mean(axis=0)) / spread

    def loss(unknowns: Array) -> tuple[float, Array]:
        margin = sign * (z @ unknowns[:-1] + unknowns[-1])
        pull = -share * sign / (1 + np.exp(np.clip(margin, -500, 500)))
        value = share @ np.logaddexp(0, -margin) + RIDGE * unknowns[:-1] @ unknowns[:-1]
        return float(value), np.append(z.T @ pull + 2 * RIDGE * unknowns[:-1], pull.sum())

    bounds = [(0.0, None)] * len(FEATURES) + [(None, None)]
    found = minimize(loss, np.zeros(len(FEATURES) + 1), jac=True, bounds=bounds, method="L-BFGS-B")
    return np.asarray(found.x[:-1] / spread)


def left_out(samples: Sequence[Sample]) -> Iterator[str]:
    """Lines of a table: each scene judged by what the others teach, at several coverages."""
    scenes = sorted({it.scene for it in samples if it.kind == "natural"})
    trusts = np.full(len(samples), np.nan)
    for scene in scenes:
        options = fit([it for it in samples if it.scene != scene])
        for i, it in enumerate(samples):
            if it.scene == scene:
                trusts[i] = trust_of(it.evidence, options)
    yield from _table(
        [(f"{scene} left out", scene) for scene in scenes] + [("all, each left out", None)], samples, trusts
    )


def fitted(samples: Sequence[Sample], options: JudgeOptions) -> Iterator[str]:
    """Lines of a table: all scenes judged by given options."""
    scenes = sorted({it.scene for it in samples})
    trusts = np.array([trust_of(it.evidence, options) for it in samples])
    yield from _table([(scene, scene) for scene in scenes] + [("all", None)], samples, trusts)


def _table(rows: Sequence[tuple[str, str | None]], samples: Sequence[Sample], trusts: Array) -> Iterator[str]:
    kinds = list(dict.fromkeys(it.kind for it in samples if it.kind != "natural" and not it.right))
    yield (
        "| scene | coverage | right accepted | natural accepted, wrong | "
        + " | ".join(f"{k}, wrong" for k in kinds)
        + " |"
    )
    yield "|---|---|---|---|" + "---|" * len(kinds)
    for title, scene in rows:
        mine = np.array([scene in (None, it.scene) for it in samples]) & np.isfinite(trusts)
        for coverage in COVERAGES:
            accepted = mine & (trusts >= 1 - coverage)
            natural = _where(samples, "natural")
            right = np.array([it.right for it in samples])
            cells = [
                _share(accepted & natural & right, mine & natural & right),
                _share(accepted & natural & ~right, accepted & natural),
                *(_share(accepted & _where(samples, k) & ~right, mine & _where(samples, k) & ~right) for k in kinds),
            ]
            yield f"| {title} | {coverage:g} | " + " | ".join(cells) + " |"


def _where(samples: Sequence[Sample], kind: str) -> NDArray[np.bool_]:
    return np.array([it.kind == kind for it in samples])


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> str:
    return f"{part.sum()} of {whole.sum()} ({100 * part.sum() / whole.sum():.1f} %)" if whole.any() else "-"


def _balance(scenes: Sequence[str]) -> Array:
    """Weights (N,) of sum one, with which every scene counts alike."""
    names, index, counts = np.unique(np.array(scenes, dtype=object), return_inverse=True, return_counts=True)
    return np.asarray(1 / (len(names) * counts[index]))


def read_samples(path: Path) -> list[Sample]:
    """Those that `write_samples` wrote."""
    return [Sample(**{**it, "evidence": Evidence(**it["evidence"])}) for it in json.loads(path.read_text())]


def write_samples(path: Path, samples: Sequence[Sample]) -> None:
    """As JSON, to fit again without localizing again."""
    path.write_text(json.dumps([asdict(it) for it in samples]))


def main() -> None:
    """Fits and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--samples", type=Path, help="read from this file if it is there, else written to it")
    arguments = parser.parse_args()
    if arguments.samples and arguments.samples.is_file():
        samples = read_samples(arguments.samples)
    else:
        samples = []
        for sample in collect(arguments.data):
            if not samples or samples[-1].kind != sample.kind or samples[-1].scene != sample.scene:
                print(f"{len(samples)}: {sample.kind}, {sample.scene} ...", file=sys.stderr, flush=True)
            samples.append(sample)
        if arguments.samples:
            write_samples(arguments.samples, samples)
    options = fit(samples)
    print(f"weights = {options.weights}\nscores = {options.scores}\n")
    print("\n".join([*fitted(samples, options), "", *left_out(samples)]))


if __name__ == "__main__":
    main()
