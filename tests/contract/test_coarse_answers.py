"""How the client asks for a coarse pose and how it reads one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import grpc
import numpy as np
import pytest
from support.clients import hosted
from support.servers import CAMERA, PHOTO, pose

from mapless import Client, DeadlineExceeded, LocalizationResult, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import (
    LocalizationServiceServicer,
    add_LocalizationServiceServicer_to_server,
)


class Hasty(LocalizationServiceServicer):
    """Never has the time to refine."""

    def Localize(self, request: pb.LocalizeRequest, context: grpc.ServicerContext) -> pb.LocalizeResponse:  # noqa: N802
        if not request.options.allow_coarse:
            context.abort(grpc.StatusCode.DEADLINE_EXCEEDED, "no time to refine")
        found = pb.Localization(world_from_camera=wire.transform_to_message(pose(1.0)), pose_stage=pb.POSE_STAGE_COARSE)
        return pb.LocalizeResponse(localization=found)


@pytest.fixture
def client() -> Iterator[Client]:
    with hosted(add=partial(add_LocalizationServiceServicer_to_server, Hasty())) as address, Client(address) as client:
        yield client


def test_a_coarse_pose_has_its_stage(client: Client) -> None:
    answer = client.localize(PHOTO, CAMERA, "s", allow_coarse=True)
    assert isinstance(answer, LocalizationResult)
    assert answer.pose_stage == "COARSE"
    assert answer.covariance is None
    assert answer.accuracy is None
    np.testing.assert_allclose(answer.world_from_camera.translation, pose(1.0).translation)


def test_it_is_not_allowed_unless_asked_for(client: Client) -> None:
    with pytest.raises(DeadlineExceeded, match="no time to refine"):
        client.localize(PHOTO, CAMERA, "s")
