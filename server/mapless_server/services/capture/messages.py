"""The messages of a call that can be captured, whichever method's it is."""

from __future__ import annotations

from mapless.v1 import localization_service_pb2 as pb

Request = pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
Response = pb.LocalizeResponse | pb.LocalizeRigResponse | pb.LocalizeSequenceResponse


def diagnostics_of(response: Response) -> list[pb.Diagnostics]:
    """Of each photograph, in order."""
    if isinstance(response, pb.LocalizeResponse):
        return [response.diagnostics]
    return [image.diagnostics for image in response.images]
