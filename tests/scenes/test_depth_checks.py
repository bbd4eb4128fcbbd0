"""Sentences about wrong depths of a scene: each is named once, with the reference that has it."""

from mapless_server.method.structure.depth_mistakes import DepthVerdict
from mapless_server.scenes.agreement import Agreement
from mapless_server.scenes.depth_checks import DepthCheck, depth_warnings


def check(*neighbours: str, mistake: str = "", doubt: str = "") -> DepthCheck:
    return DepthCheck("key", DepthVerdict(100, 50, mistake=mistake, doubt=doubt), neighbours)


def test_a_wrong_depth_explains_the_doubts_of_its_neighbours() -> None:
    found = {
        "a": check("b", "c", doubt="it is mirrored"),
        "b": check("a", "c", mistake="it is mirrored"),
        "c": check("d"),
        "d": check("c", doubt="it is shifted"),
    }
    assert depth_warnings(found) == [
        "the depth of reference 'b': it is mirrored",
        "the depth of reference 'd': either this depth is wrong or that of 'c': it is shifted",
    ]


def test_two_that_doubt_each_other_are_named_once() -> None:
    found = {"a": check("b", doubt="it is long"), "b": check("a", doubt="it is short")}
    assert depth_warnings(found) == [
        "the depth of reference 'a': either this depth is wrong or that of 'b': it is long"
    ]


def test_many_wrong_depths_are_counted() -> None:
    found = {str(i): check(mistake="it is mirrored") for i in range(10)}
    assert len(texts := depth_warnings(found)) == 4
    assert texts[-1] == "the depths of 7 more references are wrong, too"


def test_depths_are_not_judged_in_an_unknown_unit_or_by_wrong_poses() -> None:
    known = Agreement(depths=("the depth of reference 'a': it is mirrored",))
    assert known.warnings(arbitrary_unit=False) == list(known.depths)
    assert known.warnings(arbitrary_unit=True) == []
    contradicting = Agreement(10, 2, mostly_disagrees=True, depths=known.depths)
    assert contradicting.warnings(arbitrary_unit=False) == [contradicting.contradiction]
