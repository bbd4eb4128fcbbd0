"""Groups of scenes that callers name: no more is kept of them than scenes that exist account for."""

from pathlib import Path

import pytest

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.errors import NotFound
from mapless_server.security import Principal, SceneKey
from mapless_server.services.finding import SceneFinder
from mapless_server.services.reach import Reach
from mapless_server.store import SceneAttributes, Store


def test_groups_without_scenes_are_not_kept(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        finder = SceneFinder(store, Reach(store))
        for i in range(20):
            request = pb.LocalizeRequest()
            request.scene_group.labels["site"] = f"made-up-{i}"
            with pytest.raises(NotFound):
                finder.find(request, Principal())
        assert (finder._groups.values(), finder._groups.used) == ([], 0)


def test_a_kept_group_counts_as_itself_and_its_scenes(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        for i in range(3):
            store.create_scene(SceneKey(f"s{i}"), SceneAttributes(), {"site": "a"})
        finder, request = SceneFinder(store, Reach(store)), pb.LocalizeRequest()
        request.scene_group.labels["site"] = "a"
        assert finder.find(request, Principal()) is finder.find(request, Principal())
        assert finder._groups.used == 4
