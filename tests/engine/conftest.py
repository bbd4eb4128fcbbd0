"""An engine of two tiers with a scene of three references."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.images import encode, textured
from support.planted_engine import SCENE, Setting
from support.servers import CAMERA, pose

from mapless_server.engine.query import Photo
from mapless_server.scenes.scene_agreements import SceneAgreements
from mapless_server.store import NewReference, Store


@pytest.fixture(autouse=True)
def _without_agreements(monkeypatch: pytest.MonkeyPatch) -> None:
    """How well a scene's poses agree is found in a thread of its own, which reads and describes references, too."""
    monkeypatch.setattr(SceneAgreements, "touch", lambda *_: None)


@pytest.fixture
def setting(tmp_path: Path) -> Iterator[Setting]:
    with Store.open(tmp_path) as store:
        setting = Setting(store)
        store.create_scene(SCENE)
        photos = [Photo(encode(".png", textured(seed=i)), CAMERA, "image") for i in range(3)]
        described = setting.describe_all(photos)
        store.add_references(
            SCENE,
            [
                NewReference(f"r{i}", photo.image, CAMERA, pose(float(i)), found.views, found.descriptors)
                for i, (photo, found) in enumerate(zip(photos, described, strict=True))
            ],
        )
        for extractor in setting.extractors.values():
            extractor.seen.clear()
        yield setting
        setting.close()
