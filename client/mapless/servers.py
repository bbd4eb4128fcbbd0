"""The servers of a connection: calls take turns, and pass over a server that was lost a moment ago."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

from google.protobuf import wrappers_pb2

from .v1.localization_service_pb2_grpc import LocalizationServiceStub
from .v1.reference_service_pb2_grpc import ReferenceServiceStub

# grpc.health.v1 in protobuf's own messages, which saves a dependency: the request has the service's name in field 1,
# empty for the whole server, and the answer an enum in field 1.
_WRAPPERS: Any = wrappers_pb2  # the module is not annotated
HealthRequest, _HealthResponse = _WRAPPERS.StringValue, _WRAPPERS.UInt32Value


class Server:
    """One server, or several behind one name: its address, channel and methods, and what was noticed of it."""

    def __init__(self, address: str, channel: Any) -> None:
        self.address = address
        self.channel = channel
        self.methods: dict[str, Any] = {
            **vars(LocalizationServiceStub(channel)),
            **vars(ReferenceServiceStub(channel)),
            "Check": channel.unary_unary(
                "/grpc.health.v1.Health/Check",
                request_serializer=HealthRequest.SerializeToString,
                response_deserializer=_HealthResponse.FromString,
            ),
        }
        self.lost_until_s = -math.inf
        self.has_warned = False


class Servers:
    """The servers of a connection, for any number of threads.

    `were_reached` says whether one of them has ever been connected to.
    """

    def __init__(self, addresses: Sequence[str], channels: Sequence[Any]) -> None:
        self.all = tuple(map(Server, addresses, channels))
        self.were_reached = False
        self._turns = itertools.count()

    def next(self, now_s: float) -> Server:
        """The server of the next call; if all were lost a moment ago, the one for which this is longest ago."""
        first = next(self._turns) % len(self.all)
        turn = (*self.all[first:], *self.all[:first])
        return min(turn, key=lambda it: max(it.lost_until_s, now_s))
