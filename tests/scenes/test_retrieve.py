"""The choice of references: planted counts and positions, and a slow implementation."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.scenes import CAMERA, SceneOptions, make_scene, random_for, unit_rows

from mapless.geometry import Array, RigidTransform
from mapless_server.method.views import Features, PosedView, View
from mapless_server.scenes.retrieval.ranking import RetrieveOptions, spread_choice
from mapless_tools.evaluate.references import choose_references


def bare_view(descriptors: Array) -> View:
    n = len(descriptors)
    return View(CAMERA, Features(np.zeros((n, 2), np.float32), descriptors.astype(np.float32), np.ones(n, np.float32)))


def slow_choice(counts: list[int], centres: Array, count: int, options: RetrieveOptions) -> list[int]:
    """A slow implementation: best score first, where a reference near a chosen one has a lower score."""
    chosen: list[int] = []
    while len(chosen) < min(count, len(counts)):
        scores = {
            i: counts[i]
            * (
                options.nearby_weight
                if any(np.linalg.norm(centres[i] - centres[c]) < options.apart_m for c in chosen)
                else 1.0
            )
            for i in range(len(counts))
            if i not in chosen
        }
        chosen.append(max(scores, key=lambda i: (scores[i], -i)))
    return chosen


@given(
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 12)), max_size=8),
    st.integers(0, 9),
    st.sampled_from([0.0, 0.25, 0.5, 1.0]),
    st.sampled_from([0.0, 0.3, 5.0]),
)
def test_the_choice_equals_brute_force(
    candidates: list[tuple[int, int]], count: int, nearby_weight: float, apart_m: float
) -> None:
    counts = [matches for matches, _ in candidates]
    centres = np.array([[0.1 * place, 0.0, 0.0] for _, place in candidates]).reshape(-1, 3)
    options = RetrieveOptions(apart_m, nearby_weight)
    assert spread_choice(counts, centres, count, options) == slow_choice(counts, centres, count, options)


def test_references_that_see_more_of_the_query_are_chosen() -> None:
    scene = make_scene(random_for("retrieve"), SceneOptions(reference_count=4))
    elsewhere = make_scene(random_for("elsewhere"), SceneOptions(reference_count=4))
    candidates = [*elsewhere.references, *scene.references]
    assert set(choose_references(scene.query, candidates, 4)) == {4, 5, 6, 7}
    assert choose_references(scene.query, [], 4) == []


def test_the_ratio_decides_what_counts_as_a_match() -> None:
    """One reference shows little, clearly; another shows much, faintly: behind many that look nearly the same."""
    random = random_for("ratio")
    query = unit_rows(random.standard_normal((60, 32)))
    clear = np.concatenate([query[:20], unit_rows(random.standard_normal((100, 32)))])
    faint = np.concatenate([query, unit_rows(query + 0.03 * random.standard_normal(query.shape))])
    faint = unit_rows(faint + 0.03 * random.standard_normal(faint.shape))
    posed = [
        PosedView(str(i), str(i), bare_view(d), RigidTransform(np.eye(3), np.array([i, 0.0, 0.0])))
        for i, d in enumerate((clear, faint))
    ]
    assert choose_references(bare_view(query), posed, 1, ratio=0.5) == [0]
    assert choose_references(bare_view(query), posed, 1, ratio=1.0) == [1]
