"""Every call that concerns a scene names it in the metadata, with characters that metadata can carry."""

import re
from typing import Any

import pytest
from google.protobuf import empty_pb2
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clients import Connect, Recording, awaiting, hosted

from mapless import Client, ConnectOptions, names
from mapless.errors import MaplessError
from mapless.routing import SCENE_KEY, scene_metadata
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as reference_pb

SERVICES = [
    localization_pb.DESCRIPTOR.services_by_name["LocalizationService"],
    reference_pb.DESCRIPTOR.services_by_name["ReferenceService"],
]
REQUESTS: dict[str, Any] = {
    method.name: getattr(module, method.input_type.name)
    for module, service in zip((localization_pb, reference_pb), SERVICES, strict=True)
    for method in service.methods
}
OF_NO_SCENE = {"ListScenes"}
IDS = st.text("Az09_.-", min_size=1, max_size=128).filter(lambda it: it.strip(".-") == it and ".." not in it)


def about(request: Any, scene_id: str) -> Message:
    """A request that concerns the scene, in whichever of its fields that is said."""
    known: dict[str, Any] = request.DESCRIPTOR.fields_by_name
    given: dict[str, Any] = {"scene": f"scenes/{scene_id}"}
    if "scene_id" in known:
        given = {"scene_id": scene_id}
    elif "name" in known:
        of_reference = "Reference" in request.DESCRIPTOR.name
        given = {"name": f"scenes/{scene_id}/references/r" if of_reference else f"scenes/{scene_id}"}
    elif known["scene"].message_type is not None:
        given = {"scene": reference_pb.Scene(name=f"scenes/{scene_id}")}
    message: Message = request(**given)
    return message


@settings(max_examples=20)
@given(scene_id=IDS)
def test_every_method_routes_by_its_scene(scene_id: str) -> None:
    for method in REQUESTS.keys() - OF_NO_SCENE:
        assert scene_metadata(about(REQUESTS[method], scene_id)) == ((SCENE_KEY, f"scenes/{scene_id}"),), method


def test_calls_without_a_scene_have_no_routing_header() -> None:
    empty: Any = empty_pb2
    assert scene_metadata(empty.Empty()) == ()
    for method in OF_NO_SCENE:
        assert scene_metadata(REQUESTS[method]()) == ()


@given(scene=st.one_of(st.text(), st.text().map("scenes/".__add__), st.text().map("scenes/a\n/references/".__add__)))
def test_invalid_names_pass_and_valid_names_fit_a_header(scene: str) -> None:
    for request in (localization_pb.LocalizeRequest(scene=scene), reference_pb.GetReferenceRequest(name=scene)):
        for key, value in scene_metadata(request):
            assert (key, value) == (SCENE_KEY, f"scenes/{names.check_id(value.removeprefix('scenes/'))}")
            assert re.fullmatch(r"[!-~]{8,135}", value)


@pytest.mark.parametrize("connect", [Client, awaiting], ids=["blocking", "asyncio"])
def test_clients_send_it_beside_what_they_always_send(connect: Connect) -> None:
    recording = Recording(refuses=True)
    options = ConnectOptions(token="t", client_id="robot-7")
    with hosted(recording) as address, connect(address, options) as client:
        for call in (
            lambda: client.get_scene("kitchen"),
            lambda: client.get_reference("scenes/hall", "r1"),
            lambda: list(client.list_references("a.b")),
            lambda: list(client.list_scenes()),
            lambda: client.get_scene("no\nname"),
        ):
            with pytest.raises(MaplessError):
                call()
    assert [it.get(SCENE_KEY) for it in recording.metadata] == [
        "scenes/kitchen",
        "scenes/hall",
        "scenes/a.b",
        None,
        None,
    ]
    assert all((it["authorization"], it["x-client-id"]) == ("Bearer t", "robot-7") for it in recording.metadata)
