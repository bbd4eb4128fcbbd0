"""An audit of what is stored: damaged and vanishing references cost themselves and no other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import SceneOptions, make_scene
from support.stores import damage

from mapless_server.errors import NotFound, Unavailable
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.structure.depth_mistakes import DepthVerdict
from mapless_server.scenes import AuditVerdict, CoverageVerdict, Viewpoint
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.audit.scene_auditor import SceneAuditor, SceneTools
from mapless_server.scenes.depth_checks import DepthCheck, DepthChecks
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store

KEY = SceneKey("s")
OPTIONS = SceneOptions(point_count=250, reference_count=6, baseline_m=0.4, noise_px=0.3, distractor_count=40)
REFERENCES: list[PosedView] = list(make_scene(np.random.default_rng(7), OPTIONS).references)
FLAT = {"flat": np.full(4, 0.5, np.float32)}


class Extractor:
    name = "planted"

    def extract(self, *_: Any) -> View:
        raise NotImplementedError


@dataclass
class Descriptor:
    """All descriptors are equal: enough where neighbours are found by pose."""

    name: str = "flat"
    dimension: int = 4
    extractor: str | None = "planted"

    def describe(self, view: View) -> NDArray[np.float32]:
        return np.full(4, 0.5, np.float32)


def new(i: int) -> NewReference:
    reference = REFERENCES[i]
    views, descriptors = {"planted": reference.view}, FLAT
    camera = reference.view.camera
    return NewReference(f"r{i}", b"photograph %d" % i, camera, reference.world_from_camera, views, descriptors)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path) as store:
        store.create_scene(KEY)
        store.add_references(KEY, [new(i) for i in range(len(REFERENCES))])
        yield store


def tools_of(store: Store) -> SceneTools:
    library, descriptor, extractor = ReferenceLibrary(store), Descriptor(), Extractor()
    return SceneTools(
        library, SceneIndexes(store, library, descriptor, extractor, 2**30), descriptor, extractor, PairMatches()
    )


def go_on() -> None:
    pass


def verdicts(auditor: SceneAuditor, ids: list[str]) -> list[AuditVerdict | None]:
    audits = [auditor.audit(it, go_on) for it in ids]
    return [None if audit is None else audit.verdict for audit in audits]


@pytest.mark.parametrize("what", ["features", "descriptor", "pose"])
def test_a_damaged_reference_is_named_and_neighbours_are_judged(store: Store, what: str) -> None:
    damage(store, KEY, "r2", what)
    auditor = SceneAuditor(tools_of(store), KEY)
    ids = [f"r{i}" for i in range(len(REFERENCES))]
    consistent = [AuditVerdict.CONSISTENT] * len(REFERENCES)
    assert verdicts(auditor, ids) == [*consistent[:2], AuditVerdict.UNVERIFIABLE, *consistent[3:]]
    audit = auditor.audit("r2", go_on)
    assert audit is not None
    assert audit.message == "is damaged in the store: delete it and add it again"
    view = Viewpoint(REFERENCES[0].view.camera, REFERENCES[0].world_from_camera)
    coverage = auditor.check_coverage(view, go_on)
    assert coverage.verdict is not CoverageVerdict.NOT_LOCALIZABLE
    assert "scenes/s/references/r2" not in coverage.references


def test_a_neighbour_deleted_during_an_audit_loses_no_answer(store: Store) -> None:
    """Once before anything was loaded, once when it had been looked at."""
    auditor = SceneAuditor(tools_of(store), KEY)
    auditor._read()
    store.delete_reference(KEY, "r1")
    assert verdicts(auditor, ["r0"]) == [AuditVerdict.CONSISTENT]
    store.delete_reference(KEY, "r3")
    view = Viewpoint(REFERENCES[0].view.camera, REFERENCES[0].world_from_camera)
    assert auditor.check_coverage(view, go_on).verdict is not CoverageVerdict.NOT_LOCALIZABLE
    assert verdicts(auditor, ["r2", "r3", "r4"]) == [AuditVerdict.CONSISTENT, None, AuditVerdict.CONSISTENT]


class Depths:
    """r0 and r1 doubt each other, as r2 and r3 do; r3 is wrong."""

    def check(self, scene_key: SceneKey, reference_id: str, check: Any) -> DepthCheck | None:
        neighbour = {"r0": "r1", "r1": "r0", "r2": "r3", "r3": "r2"}.get(reference_id)
        if neighbour is None:
            return None
        mistake, doubt = ("it is long", "") if reference_id == "r3" else ("", "it is short")
        return DepthCheck(reference_id, DepthVerdict(mistake=mistake, doubt=doubt), (neighbour,))


def test_doubts_about_depths_are_findings_unless_a_wrong_one_explains_them(store: Store) -> None:
    auditor = SceneAuditor(replace(tools_of(store), depths=cast("DepthChecks", Depths())), KEY)
    doubtful, found = AuditVerdict.DOUBTFUL_DEPTH, verdicts(auditor, ["r0", "r1", "r2", "r3", "r4"])
    assert found == [doubtful, doubtful, AuditVerdict.CONSISTENT, AuditVerdict.WRONG_DEPTH, AuditVerdict.CONSISTENT]
    assert not doubtful.is_alarm
    audit = auditor.audit("r0", go_on)
    assert audit is not None
    assert audit.message.endswith("either this depth is wrong or that of 'r1': it is short")


def test_a_deleted_reference_is_an_error_only_if_named(store: Store) -> None:
    tools = tools_of(store)
    listed, named = SceneAuditor(tools, KEY), SceneAuditor(tools, KEY, named=["r4", "r0"])
    listed._read()
    named._read()
    store.delete_reference(KEY, "r0")
    assert verdicts(listed, ["r0"]) == [None]
    with pytest.raises(NotFound) as caught:
        named.audit("r0", go_on)
    assert caught.value.field == "references[1]"
    store.delete_scene(KEY)
    for auditor in (listed, named):
        with pytest.raises(NotFound) as caught:
            auditor.audit("r4", go_on)
        assert caught.value.field == "scene"


def test_one_that_was_added_since_the_scene_was_read_is_audited(store: Store) -> None:
    store.delete_reference(KEY, "r5")
    auditor = SceneAuditor(tools_of(store), KEY)
    auditor._read()
    before = auditor.generation
    store.add_references(KEY, [new(5)])
    assert verdicts(auditor, ["r5"]) == [AuditVerdict.CONSISTENT]
    assert auditor.generation > before


def test_a_scene_that_never_holds_still_is_unavailable(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its subject is loaded, and not there any more when it is looked at; again and again."""
    auditor = SceneAuditor(tools_of(store), KEY)
    readings: list[Sequence[str]] = []

    def load(names: Sequence[str]) -> list[PosedView]:
        readings.append(names)
        return []

    monkeypatch.setattr(auditor, "_load", load)
    with pytest.raises(Unavailable) as caught:
        auditor.audit("r0", go_on)
    assert caught.value.reason == "SCENE_CHANGED"
    assert len(readings) == 3


def test_neighbours_among_rows_with_holes_are_the_nearest(store: Store) -> None:
    store.delete_reference(KEY, "r1")
    auditor = SceneAuditor(tools_of(store), KEY)
    finder = auditor._finder(auditor._read().rows())
    left = {f"scenes/s/references/r{i}": REFERENCES[i].world_from_camera for i in range(len(REFERENCES)) if i != 1}
    np.testing.assert_array_equal(finder.origin, REFERENCES[0].world_from_camera.translation)
    for name, pose in left.items():
        np.testing.assert_allclose(finder.pose(name).matrix(), pose.shifted(-finder.origin).matrix(), atol=1e-12)
        assert set(finder.near(name, 4)) == left.keys() - {name}
        (nearest,) = finder.near(name, 1)
        away_m = {it: np.linalg.norm(left[it].translation - pose.translation) for it in left if it != name}
        assert away_m[nearest] <= 1.5 * min(away_m.values())
