"""A photograph of one of several scenes: what clients and the command send, and what they say of the answer."""

from typing import Any

import pytest
from support.clients import Played
from support.planted_answers import diagnostics, localized, rejected, truth
from support.servers import CAMERA, PHOTO

from mapless import ConnectOptions, GroupRejected, Hint, Hypothesis, ImageReport, wire
from mapless.calls.localization import localize
from mapless.cli.arguments import make_parser
from mapless.cli.localize import _group_of
from mapless.cli.output import heading, line
from mapless.diagnostics import Diagnostics
from mapless.messages import answer_from_message
from mapless.routing import SCENE_KEY, scene_metadata
from mapless.v1 import localization_service_pb2 as pb


def sent(*arguments: Any, **named: Any) -> pb.LocalizeRequest:
    """The request of a call."""
    answer = pb.LocalizeResponse(rejection=pb.Rejection(reason=pb.REJECTION_REASON_GATE))
    played = Played(lambda it: localize(it, PHOTO, CAMERA, *arguments, **named), [answer], ConnectOptions())
    ((_, request),) = played.calls
    assert isinstance(request, pb.LocalizeRequest)
    return request


def test_a_request_names_one_scene_several_or_a_group() -> None:
    one, several = sent("hall"), sent(scenes=["hall", "scenes/yard"], prior_scene="hall")
    assert (one.scene, list(one.scenes), one.HasField("scene_group")) == ("scenes/hall", [], False)
    assert (several.scene, list(several.scenes), several.prior_scene) == (
        "",
        ["scenes/hall", "scenes/yard"],
        "scenes/hall",
    )
    group, all_scenes = sent(group={"site": "a", "floor": "2"}), sent(group={})
    assert (group.scene, dict(group.scene_group.labels)) == ("", {"site": "a", "floor": "2"})
    assert all_scenes.HasField("scene_group")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "scene, scenes or group is required"),
        ({"scenes": []}, "scene, scenes or group is required"),
        ({"scene": "hall", "with_datum": True}, "with_datum needs group"),
        ({"with_datum": True}, "with_datum needs group"),
        ({"group": {"floor": 2}}, r"group must have labels of text, 'floor' has 2$"),
        ({"scene": "hall", "group": {}}, "group must not be given together with scene"),
        ({"scenes": ["a"], "group": {}}, "group must not be given together with scenes"),
        ({"scenes": "hall"}, "scenes must be a list"),
        ({"group": "site-a"}, "group must be labels by name"),
        ({"group": {}, "references": ["r"]}, "scene must be its id or name"),
    ],
)
def test_other_ways_to_say_where_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        sent(**arguments)


def test_calls_for_the_same_scenes_are_routed_alike() -> None:
    def key(**where: Any) -> str:
        ((name, value),) = scene_metadata(sent(**where))
        assert name == SCENE_KEY
        return value

    assert key(scenes=["b", "a"]) == key(scenes=["a", "b"]) == "scenes/a"
    assert key(group={"b": "2", "a": "é 1"}) == key(group={"a": "é 1", "b": "2"}) == "scenes?a=%C3%A9+1&b=2"
    assert scene_metadata(sent(group={f"l{i}": "x" * 100 for i in range(9)})) == ()


def test_answers_and_hypotheses_name_their_scenes() -> None:
    pose = wire.transform_to_message(truth())
    message = pb.LocalizeResponse(scene="scenes/yard", localization=pb.Localization(world_from_camera=pose))
    resembles = {"reference_count": 7, "similarity": 0.4, "match_count": 90, "attempted": True}
    message.diagnostics.scenes.add(scene="scenes/yard", **resembles)
    message.diagnostics.searched_scene_count = 12
    answer = answer_from_message(message)
    assert answer.scene == "scenes/yard"
    (use,) = answer.diagnostics.scenes
    assert (use.scene, use.reference_count, use.match_count, use.attempted) == ("scenes/yard", 7, 90, True)
    ambiguous = pb.LocalizeResponse(scene="scenes/yard", rejection=pb.Rejection(reason=pb.REJECTION_REASON_AMBIGUOUS))
    for scene in ("yard", "hall"):
        ambiguous.rejection.hypotheses.add(scene=f"scenes/{scene}", world_from_camera=pose)
    refused = answer_from_message(ambiguous)
    assert [it.scene for it in refused.hypotheses] == ["scenes/yard", "scenes/hall"]  # type: ignore[union-attr]


def among(count: int) -> Diagnostics:
    return Diagnostics(**{**vars(diagnostics()), "searched_scene_count": count})


def test_text_names_the_scene_where_it_was_found() -> None:
    found = localized(scene="scenes/yard", diagnostics=among(12))
    assert str(found).startswith("localized in yard, trust 0.400\n")
    assert str(localized(scene="")).startswith("localized, trust 0.400\n")  # of a server before 0.4
    assert "  of 12 scenes, yard matched best\n" in str(rejected(scene="scenes/yard", diagnostics=among(12))) + "\n"


def test_text_names_the_scene_where_only_one_was_searched() -> None:
    assert str(rejected(scene="scenes/yard", diagnostics=among(1))).startswith("not localized in yard: ")


def test_references_and_poses_among_scenes_name_theirs() -> None:
    hint = Hint("judge", "TELL_PLACES_APART", "Name the scene.", "scenes/church/references/0004")
    places = tuple(Hypothesis(truth(), 50 + i, (), scene=f"scenes/{it}") for i, it in enumerate(("church", "office")))
    answer = rejected(reason="AMBIGUOUS", scene="scenes/church", hint=hint, hypotheses=places, diagnostics=among(2))
    text = str(answer).splitlines()
    assert "  shares most with reference church/0004" in text
    x, y, z = truth().translation
    assert f"  pose in office: position  {x:.3f}  {y:.3f}  {z:.3f}, 51 inliers" in text
    assert not any("matched best" in it for it in text)
    rig = GroupRejected("AMBIGUOUS", "planted", (ImageReport(0, 0, None, among(2)),), hint, places, scene=answer.scene)
    assert "  shares most with reference church/0004" in str(rig).splitlines()


def test_a_wrong_label_is_of_its_flag() -> None:
    parsed = make_parser().parse_args(["localize", "photo.jpg", "--group", "s i=a"])
    with pytest.raises(ValueError, match="--group must have names of"):
        _group_of(parsed)


def test_the_table_of_a_folder_ends_with_scenes() -> None:
    row = line("a-name.jpg", localized(scene="scenes/yard"), with_scene=True)
    assert row.endswith("  yard")
    assert heading(10, with_scene=True).index("scene") == row.index("yard")


@pytest.mark.parametrize(
    ("given", "scene", "scenes", "group"),
    [
        ("hall photo.jpg", "hall", [], None),
        ("hall --count 3 photo.jpg", "hall", [], None),
        ("--group site-a photo.jpg", "", [], {"group": "site-a"}),
        ("photo.jpg --group=site=a --group floor=2", "", [], {"site": "a", "floor": "2"}),
        ("--scene hall photo.jpg --scene yard", "", ["hall", "yard"], None),
    ],
)
def test_the_command_takes_a_scene_or_finds_it(
    given: str, scene: str, scenes: list[str], group: dict[str, str] | None
) -> None:
    parsed = make_parser().parse_args(["localize", *given.split()])
    assert (parsed.scene, parsed.photo.name, parsed.scenes, _group_of(parsed)) == (scene, "photo.jpg", scenes, group)


def test_help_shows_that_the_scene_can_be_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        make_parser().parse_args(["localize", "--help"])
    assert "[scene] photo\n" in capsys.readouterr().out


@pytest.mark.parametrize("given", ["=a", "site=", "site=a --group site=b"])
def test_a_group_of_no_label_is_refused(given: str) -> None:
    with pytest.raises(ValueError, match="--group"):
        _group_of(make_parser().parse_args(["localize", "photo.jpg", "--group", *given.split()]))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("photo.jpg", "required: photo"),
        ("hall --anywhere photo.jpg", "SCENE is not taken together with --anywhere"),
        ("--group a --anywhere photo.jpg", "not allowed with"),
    ],
)
def test_a_command_that_says_where_in_two_ways_is_refused(
    given: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        make_parser().parse_args(["localize", *given.split()])
    assert message in capsys.readouterr().err
