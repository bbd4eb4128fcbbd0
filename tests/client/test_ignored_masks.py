"""A server that is older than masks ignores them; the client says so, once for each server."""

import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.clients import Connect, awaiting, failing
from support.images import encode
from support.servers import CAMERA, PHOTO, make_scene, pose, serving

from mapless import Client, IgnoredMask, NewReference, RigidTransform, RigImage
from mapless.__main__ import main

MASK = encode(".png", np.full((64, 96), 255, np.uint8))
RIG_IMAGE = RigImage(PHOTO, CAMERA, RigidTransform.identity(), mask=MASK)
CALLS: dict[str, Callable[[Client], Any]] = {
    "localize": lambda it: it.localize(PHOTO, CAMERA, "s", mask=MASK),
    "localize_rig": lambda it: it.localize_rig([RIG_IMAGE], "s"),
    "retrieve": lambda it: it.retrieve_references(PHOTO, CAMERA, "s", mask=MASK),
    "add": lambda it: it.add_reference("s", NewReference("new", PHOTO, CAMERA, pose(7), MASK)),
    "batch": lambda it: it.add_references("s", [NewReference("more", PHOTO, CAMERA, pose(8), MASK)]),
}


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("data")) as server:
        with Client(server.address) as client:
            make_scene(client)
        yield server.address


@pytest.fixture(scope="module")
def old(address: str) -> Iterator[str]:
    """A way to the server on which its trailers are lost, as if it sent none."""
    with grpc.insecure_channel(address) as channel:

        def forward(method: str, data: bytes) -> bytes:
            return bytes(channel.unary_unary(method)(data, timeout=30))

        with failing([], forward) as (old, _):
            yield old


@pytest.mark.parametrize("connect", [Client, awaiting], ids=["blocking", "asyncio"])
@pytest.mark.parametrize("call", CALLS)
def test_an_older_server_that_ignores_a_mask_is_named(call: str, connect: Connect, address: str, old: str) -> None:
    def make(client: Client) -> None:
        CALLS[call](client)
        for name in {it.reference_id for it in client.list_references("s")} & {"new", "more"}:
            client.delete_reference("s", name)

    with connect(old) as client:
        with pytest.warns(IgnoredMask, match=f"the server {old} has ignored the mask"):
            make(client)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make(client)
    with connect(address) as client, warnings.catch_warnings():
        warnings.simplefilter("error")
        make(client)


def test_calls_without_a_mask_warn_of_nothing(old: str) -> None:
    with Client(old) as client, warnings.catch_warnings():
        warnings.simplefilter("error")
        client.localize(PHOTO, CAMERA, "s")


def test_the_command_says_it_too(old: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo, mask, camera = tmp_path / "photo.png", tmp_path / "mask.png", tmp_path / "camera.json"
    photo.write_bytes(PHOTO)
    mask.write_bytes(MASK)
    focal = {"focal_x_px": 80, "focal_y_px": 81, "principal_x_px": 47.5, "principal_y_px": 31.5}
    camera.write_text(json.dumps({"width_px": 96, "height_px": 64} | focal))
    with pytest.raises(SystemExit) as ended, warnings.catch_warnings():
        main(["retrieve", "s", str(photo), "--camera", str(camera), "--mask", str(mask), "--address", old])
    assert ended.value.code == 0
    assert f"mapless: warning: the server {old} has ignored the mask" in capsys.readouterr().err
