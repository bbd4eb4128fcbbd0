"""mapless: visual localization without a map; the client.

>>> with Client("localhost:50051") as client:
...     answer = client.localize("photo.jpg", camera, scene="kitchen")
"""

from .client import Client, NewReference, PositionPrior
from .errors import (
    AlreadyExists,
    DataLoss,
    DeadlineExceeded,
    FailedPrecondition,
    Internal,
    InvalidArgument,
    MaplessError,
    NotFound,
    PermissionDenied,
    ResourceExhausted,
    Unauthenticated,
    Unavailable,
)
from .geometry import Camera, Fisheye, Quaternion, RadialTangential, RigidTransform
from .options import ConnectOptions
from .results import Accuracy, Diagnostics, LocalizationResult, Reference, ReferenceUse, Rejected, ScaleEstimate, Scene

__all__ = [
    "Accuracy",
    "AlreadyExists",
    "Camera",
    "Client",
    "ConnectOptions",
    "DataLoss",
    "DeadlineExceeded",
    "Diagnostics",
    "FailedPrecondition",
    "Fisheye",
    "Internal",
    "InvalidArgument",
    "LocalizationResult",
    "MaplessError",
    "NewReference",
    "NotFound",
    "PermissionDenied",
    "PositionPrior",
    "Quaternion",
    "RadialTangential",
    "Reference",
    "ReferenceUse",
    "Rejected",
    "ResourceExhausted",
    "RigidTransform",
    "ScaleEstimate",
    "Scene",
    "Unauthenticated",
    "Unavailable",
]
