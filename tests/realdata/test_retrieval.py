"""Retrieval on real photographs: among the ten that are chosen, one sees the same place."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.scenes import RankedReference, RankOptions, Selection, rank_references
from mapless_server.scenes.retrieval.index import SceneIndex, Vector
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_server.store import IndexedReference, SceneChanges
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames

from .conftest import read_place_once

pytestmark = pytest.mark.realdata

Photographs = Callable[[str], Dataset]
EXTRACTOR = SiftExtractor()
DESCRIPTOR = VladDescriptor.of(EXTRACTOR)


def describe(frame: Frame) -> Vector:
    image = decode_image(frame.image_path.read_bytes(), ImageLimits())
    return DESCRIPTOR.describe(EXTRACTOR.extract(image, frame.camera))


def described(frames: list[Frame]) -> list[Vector]:
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(describe, frames))


def index_of(frames: list[Frame]) -> SceneIndex:
    index = SceneIndex(DESCRIPTOR.dimension)
    vectors = zip(frames, described(frames), strict=True)
    added = tuple(IndexedReference(it.name, it.name, it.world_from_camera, vector) for it, vector in vectors)
    index.apply(SceneChanges(1, added, frozenset(), True))
    return index


def sees_the_same(frame: Frame, found: list[RankedReference]) -> bool:
    errors = np.array([pose_error(frame.world_from_camera, it.world_from_camera) for it in found])
    return bool((errors <= (0.5, 30.0)).all(axis=1).any())


@pytest.mark.nightly
def test_kitchen_queries_find_a_near_reference(photographs: Photographs) -> None:
    """100 references spread over the sequence, 100 other frames: 95 % of them, thinned or not."""
    frames = photographs("7scenes-redkitchen-seq01-first600").frames
    references, asked = split_frames(frames, EvaluationOptions(reference_count=100, query_count=125))
    assert len(references) == 100
    assert len(asked) >= 100
    entries = index_of([*references]).entries()
    queries = list(zip(asked, described([*asked]), strict=True))
    for options in (RankOptions(), RankOptions(nearby_weight=1.0)):
        found = [rank_references(entries, vector, Selection(10, options=options)) for _, vector in queries]
        shares = np.mean([sees_the_same(frame, it) for (frame, _), it in zip(queries, found, strict=True)])
        assert shares >= 0.95


def test_photographs_of_two_places_find_their_own_place(photographs: Photographs) -> None:
    """In one index of a fountain and a portal, the most similar other photograph is of the same place."""
    folders = ("fountain-P11", "herz-jesus-P8")
    for folder in folders:
        photographs(folder)
    views = {(folder, i): view for folder in folders for i, view in read_place_once(folder).views.items()}
    vectors = {key: DESCRIPTOR.describe(view) for key, view in views.items()}
    places, matrix = [folder for folder, _ in vectors], np.array(list(vectors.values()))
    similarity = matrix @ matrix.T
    np.testing.assert_allclose(np.diag(similarity), 1.0, atol=1e-5)
    np.fill_diagonal(similarity, -1.0)
    assert [places[i] for i in similarity.argmax(axis=1)] == places
