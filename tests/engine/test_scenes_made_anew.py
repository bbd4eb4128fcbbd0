"""A scene that is deleted and created again, with references of the same names, while a query is computed."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from support.images import encode, textured
from support.planted_engine import DOUBTFUL_INLIERS, SCENE, SURE_INLIERS, Setting, localized
from support.servers import CAMERA, pose

from mapless.geodesy import Datum
from mapless_server.engine.failures import SceneMadeAnew
from mapless_server.engine.query import Photo
from mapless_server.errors import NotFound
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.store import NewReference, SceneAttributes, Store

NAMES = ("r0", "r1", "r2")
FIRST, SECOND = {0.0, 1.0, 2.0}, {10.0, 11.0, 12.0}
"""x of the references of the first scene, m, and of those of the second, which have the same names."""
DATUM = Datum(47.0, 8.0, 400.0)
"""The datum of the second scene; the first has none."""


def x_of(references: Sequence[PosedView]) -> set[float]:
    return {float(it.world_from_camera.translation[0]) for it in references}


@pytest.fixture
def make_anew(setting: Setting) -> Callable[[], None]:
    """Deletes the scene and makes the second one, when it is called first."""
    photos = [Photo(encode(".png", textured(seed=10 + i)), CAMERA, "image") for i in range(len(NAMES))]
    to_add = [
        NewReference(name, photo.image, CAMERA, pose(x_m), found.views, found.descriptors)
        for name, photo, x_m, found in zip(NAMES, photos, sorted(SECOND), setting.describe_all(photos), strict=True)
    ]

    def make() -> None:
        if to_add:
            setting.store.delete_scene(SCENE)
            setting.store.create_scene(SCENE, SceneAttributes(DATUM))
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
    assert result.attributes.datum == (None if expected is FIRST else DATUM)
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


@pytest.mark.parametrize("named", [NAMES, ()], ids=["named", "chosen"])
def test_a_further_attempt_is_not_mixed_with_another_scene(
    setting: Setting, make_anew: Callable[[], None], named: tuple[str, ...]
) -> None:
    """The first attempt leaves a doubt, and the scene is made anew before the second: the first answer is given."""

    def doubtful(_: View, references: Sequence[PosedView], __: Any) -> Answer:
        make_anew()
        return localized(DOUBTFUL_INLIERS, references[0].world_from_camera)

    setting.replies |= {"cheap": doubtful, "strong": localized(SURE_INLIERS, pose(11.0))}
    result = setting.localize(reference_ids=named, reference_count=len(NAMES))
    assert setting.asked == ["cheap"]
    assert x_of(result.references) == FIRST
    assert result.attributes.datum is None
    assert [it.outcome for it in result.attempts] == ["localized", "failed"]


def test_priors_of_another_datum_are_refused(setting: Setting) -> None:
    """A geographic prior was converted by attributes that have changed before the references are read."""
    before = setting.store.get_attributes(SCENE)
    setting.replies["cheap"] = localized(SURE_INLIERS)
    assert setting.localize(attributes=before).attributes.datum is None
    setting.store.update_scene(SCENE, datum=DATUM)
    with pytest.raises(SceneMadeAnew):
        setting.localize(attributes=before)
    assert setting.localize(attributes=setting.store.get_attributes(SCENE)).attributes.datum == DATUM


def test_references_and_their_scene_are_read_at_one_moment(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene gets a datum just before the transaction that reads the references begins."""
    database = setting.store.database
    read = database.read
    setting.store.get_attributes(SCENE)  # which are kept in memory

    def reading() -> Any:
        monkeypatch.setattr(database, "read", read)
        setting.store.update_scene(SCENE, datum=DATUM)
        return read()

    monkeypatch.setattr(database, "read", reading)
    assert setting.store.load_references(SCENE, NAMES, "cheap").scene.attributes.datum == DATUM
