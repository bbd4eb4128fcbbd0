"""mapless: visual localization without a map; the client.

>>> with Client("localhost:50051") as client:
...     answer = client.localize("photo.jpg", camera, scene="kitchen")
"""

from .client import Client
from .errors import (
    AlreadyExists,
    DataLoss,
    DeadlineExceeded,
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
from .requests import HeadingPrior, NewReference, PositionPrior
from .results import (
    Accuracy,
    Coverage,
    Diagnostics,
    LocalizationResult,
    Reference,
    ReferenceAudit,
    ReferenceUse,
    Rejected,
    RetrievedReference,
    ScaleEstimate,
    Scene,
)

__all__ = [
    "Accuracy",
    "AlreadyExists",
    "Camera",
    "Client",
    "ConnectOptions",
    "Coverage",
    "DataLoss",
    "DeadlineExceeded",
    "Diagnostics",
    "Fisheye",
    "HeadingPrior",
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
    "ReferenceAudit",
    "ReferenceUse",
    "Rejected",
    "ResourceExhausted",
    "RetrievedReference",
    "RigidTransform",
    "ScaleEstimate",
    "Scene",
    "Unauthenticated",
    "Unavailable",
]
