"""A scene that is deleted and created again, with references of the same names, while a query is computed."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from support.images import encode, textured
from support.planted_engine import SCENE, SURE_INLIERS, Setting, localized
from support.servers import CAMERA, pose

from mapless_server.engine.query import Photo
from mapless_server.errors import NotFound
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.store import NewReference, Store

NAMES = ("r0", "r1", "r2")
FIRST, SECOND = {0.0, 1.0, 2.0}, {10.0, 11.0, 12.0}
"""x of the references of the first scene, m, and of those of the second, which have the same names."""


def x_of(references: Sequence[PosedView]) -> set[float]:
    return {float(it.world_from_camera.translation[0]) for it in references}


@pytest.fixture
def make_anew(setting: Setting) -> Callable[[], None]:
    """Deletes the scene and makes the second one, when it is called first."""
    photos = [Photo(encode(".png", textured(seed=10 + i)), CAMERA, "image") for i in range(len(NAMES))]
    to_add = [
        NewReference(name, photo.image, CAMERA, pose(x_m), found.views, found.descriptors)
        for name, photo, x_m, found in zip(NAMES, photos, sorted(SECOND), setting.describe(photos), strict=True)
    ]

    def make() -> None:
        if to_add:
            setting.store.delete_scene(SCENE)
            setting.store.create_scene(SCENE)
            setting.store.add_references(SCENE, to_add)
            to_add.clear()

    return make


@pytest.mark.parametrize("named", [NAMES, ()], ids=["named", "chosen"])
@pytest.mark.parametrize(("moment", "expected"), [("before", SECOND), ("after", FIRST)])
def test_an_answer_is_of_one_of_two_scenes_of_a_name(
    setting: Setting,
    make_anew: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
    named: tuple[str, ...],
    moment: str,
    expected: set[float],
) -> None:
    """The second scene is made just before the references are loaded, after they were chosen, or just after it."""
    load = Store.load_references

    def loaded(*arguments: Any) -> Any:
        if moment == "before":
            make_anew()
        try:
            return load(*arguments)
        finally:
            make_anew()

    def at_the_first(_: View, references: Sequence[PosedView], __: Any) -> Answer:
        return localized(SURE_INLIERS, references[0].world_from_camera)

    monkeypatch.setattr(Store, "load_references", loaded)
    generation = setting.store.get_generation(SCENE)
    setting.replies["cheap"] = at_the_first
    result = setting.localize(reference_ids=named, reference_count=len(NAMES))
    assert x_of(result.references) == expected
    assert (result.generation == generation) is (expected is FIRST)
    assert isinstance(result.answer.outcome, Localization)
    assert x_of(result.references) >= {float(result.answer.outcome.world_from_camera.translation[0])}


@pytest.mark.parametrize("named", [NAMES, ()], ids=["named", "chosen"])
def test_an_answer_that_needs_deleted_photographs_is_of_the_second(
    setting: Setting, make_anew: Callable[[], None], named: tuple[str, ...]
) -> None:
    """References that the caller named are not found, since those of the second scene may be others."""
    read: list[set[float]] = []

    def needs_photographs(_: View, references: Sequence[PosedView], __: Any) -> Answer:
        make_anew()
        for it in references:
            assert it.view.photograph is not None
            it.view.photograph.read()
        read.append(x_of(references))
        return localized(SURE_INLIERS)

    setting.replies["cheap"] = needs_photographs
    if named:
        with pytest.raises(NotFound):
            setting.localize(reference_ids=named)
    else:
        assert x_of(setting.localize(reference_ids=named, reference_count=len(NAMES)).references) == SECOND
        assert read == [SECOND]
