"""A server that is older than depth ignores that of photographs; the client says so."""

import warnings
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.clients import Connect, awaiting, failing
from support.servers import CAMERA, PHOTO, make_scene, pose, serving

from mapless import Client, DepthImage, IgnoredDepth, RigImage
from mapless.v1 import localization_service_pb2 as pb

DEPTH = DepthImage.of_metres(np.full((64, 96), 2.0, np.float32))
RESPONSES: dict[str, Any] = {"Localize": pb.LocalizeResponse, "LocalizeRig": pb.LocalizeRigResponse}


def without_checks(method: str, data: bytes) -> bytes:
    """The answer of a method as a server makes it that does not know depth."""
    kind = RESPONSES.get(method.rpartition("/")[2])
    if kind is None:
        return data
    answer = kind.FromString(data)
    for its in answer.images if isinstance(answer, pb.LocalizeRigResponse) else [answer]:
        its.diagnostics.ClearField("depth_check")
    return bytes(answer.SerializeToString())


@pytest.mark.parametrize("connect", [Client, awaiting], ids=["blocking", "asyncio"])
def test_an_older_server_that_ignores_depth_is_named(connect: Connect, tmp_path: Path) -> None:
    with serving(tmp_path) as server, grpc.insecure_channel(server.address) as channel:
        with Client(server.address) as client:
            make_scene(client)

        def forward(method: str, data: bytes) -> bytes:
            return without_checks(method, channel.unary_unary(method)(data, timeout=30))

        with failing([], forward) as (old, _), connect(old) as client:
            with pytest.warns(IgnoredDepth, match="depth of photographs"):
                client.localize(PHOTO, CAMERA, "s", depth=DEPTH)
            with pytest.warns(IgnoredDepth):
                client.localize_rig([RigImage(PHOTO, CAMERA, pose(0.0), depth=DEPTH)], "s")
        with connect(server.address) as client, warnings.catch_warnings():
            warnings.simplefilter("error", IgnoredDepth)
            client.localize(PHOTO, CAMERA, "s", depth=DEPTH)
