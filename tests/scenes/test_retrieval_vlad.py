"""VLAD and its vocabularies: invariances, the shipped vocabularies are learned ones, and names distinguish them."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import CAMERA, SceneOptions, make_scene, random_for, unit_rows

from mapless.geometry import Array
from mapless_server.method.features import SiftExtractor
from mapless_server.method.views import Features, View
from mapless_server.scenes.retrieval.vlad import LEARNED, VladDescriptor, Vocabulary, dataless, shipped

DIGESTS = {"sift": "53ac1a6f", "aliked": "d26d2f4e", "xfeat": "8c987f94", "edgepoint2-l64": "94322c2c"}
"""Of the shipped vocabularies. Another digest makes another name, and all stored descriptors are computed again."""

LENGTHS = {"sift": 128, "aliked": 128, "xfeat": 64, "edgepoint2-l64": 64}


def view_of(descriptors: Array) -> View:
    n = len(descriptors)
    features = Features(np.zeros((n, 2), np.float32), descriptors.astype(np.float32), np.ones(n, np.float32))
    return View(CAMERA, features)


def descriptors(case: str, count: int = 500, length: int = 128) -> Array:
    return unit_rows(np.abs(random_for("vlad", case).standard_normal((count, length))))


@pytest.fixture(params=["sift", "dataless"])
def descriptor(request: pytest.FixtureRequest) -> VladDescriptor:
    return VladDescriptor("any-1", shipped("sift") if request.param == "sift" else None)


class TestDescriptor:
    def test_it_is_that_of_loops(self, descriptor: VladDescriptor) -> None:
        found = descriptors("loops", 60)
        vocabulary = shipped("sift") if "dataless" not in descriptor.name else dataless(128)
        assert vocabulary is not None
        np.testing.assert_allclose(descriptor.describe(view_of(found)), slow_vlad(found, vocabulary), atol=1e-4)

    def test_a_planted_place_resembles_itself(self, descriptor: VladDescriptor) -> None:
        here, elsewhere = (make_scene(random_for(case), SceneOptions(reference_count=4)) for case in ("here", "there"))
        query = descriptor.describe(here.query)
        own = [float(query @ descriptor.describe(it.view)) for it in here.references]
        foreign = [float(query @ descriptor.describe(it.view)) for it in elsewhere.references]
        assert min(own) > max(foreign) + 0.02

    def test_a_blank_wall_resembles_nothing(self, descriptor: VladDescriptor) -> None:
        assert not descriptor.describe(view_of(np.empty((0, 128)))).any()

    def test_features_of_another_length_are_refused(self) -> None:
        with pytest.raises(ValueError, match="have 64 numbers, the vocabulary's have 128"):
            VladDescriptor("sift-1", shipped("sift")).describe(view_of(descriptors("a", length=64)))

    @pytest.mark.parametrize("length", [8, 64, 256])
    def test_without_data_any_length_goes(self, length: int) -> None:
        vector = VladDescriptor("new-1", None).describe(view_of(descriptors("a", length=length)))
        assert float(vector @ vector) == pytest.approx(1.0, abs=1e-5)


class TestNames:
    def test_the_name_has_rule_vocabulary_and_features(self) -> None:
        extractor = SiftExtractor()
        made = VladDescriptor.of(extractor)
        assert made.name == f"vlad-1-{DIGESTS['sift']}-{extractor.name}"
        assert made.extractor == extractor.name

    def test_another_vocabulary_is_another_name(self) -> None:
        one, other = dataless(128), replace(dataless(128), mean=np.full(128, 0.01, np.float32))
        names = {VladDescriptor("x", vocabulary).name for vocabulary in (one, other, None, shipped("sift"))}
        assert len(names) == 4
        assert VladDescriptor("y", one).name != VladDescriptor("x", one).name


class TestVocabularies:
    @pytest.mark.parametrize("kind", LEARNED)
    def test_what_is_shipped_is_what_was_measured(self, kind: str) -> None:
        vocabulary = shipped(kind)
        assert vocabulary is not None
        assert vocabulary.digest() == DIGESTS[kind]
        assert len(vocabulary.mean) == LENGTHS[kind]
        assert all(np.isfinite(array).all() for array in (vocabulary.mean, vocabulary.projection, vocabulary.words))

    def test_arrays_that_do_not_fit_are_refused(self) -> None:
        good = dataless(16)
        with pytest.raises(ValueError, match="do not fit"):
            Vocabulary(good.mean[:8], good.projection, good.words)


def slow_vlad(found: Array, vocabulary: Vocabulary) -> Array:
    """The rule in words."""
    sums = np.zeros_like(vocabulary.words, dtype=float)
    for one in found.astype(np.float32):
        point = (one - vocabulary.mean) @ vocabulary.projection
        word = int(np.argmin(np.linalg.norm(vocabulary.words - point, axis=1)))
        away = point - vocabulary.words[word]
        sums[word] += away / np.linalg.norm(away)
    powered = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray((powered / np.linalg.norm(powered)).ravel())
