"""mapless: visual localization without a map; the client.

>>> answer = mapless.localize("photo.jpg", camera)

localizes a photograph with the server of MAPLESS_ADDRESS (default localhost:50051) in the scene of MAPLESS_SCENE
(default: found among all), and

>>> with Client("localhost:50051") as client:
...     answer = client.localize("photo.jpg", camera, scene="kitchen")

has all calls of the interface; `mapless.aio.Client` is the same for asyncio.

Begin with `Client` (client.py) and its calls (calls/), which return the values of answers.py, groups.py
and results.py; diagnostics.py has what they were computed from.
geometry.py states the conventions of frames and units. connection.py has retries and deadlines, wire.py and messages.py
the conversion between values and messages, report/ the HTML report of an answer, cli/ the command `mapless`.
"""

from . import aio
from .answers import Accuracy, FramedPose, Hint, Hypothesis, LocalizationResult, PriorCheck, Rejected
from .cameras import read_camera, read_cameras, read_pose
from .client import Client
from .depth import DepthImage, DepthNoise, DepthSensor, IgnoredDepth
from .diagnostics import (
    Attempt,
    Debug,
    DepthCheck,
    Diagnostics,
    LadderCut,
    MissingEvidence,
    ReferenceUse,
    ScaleEstimate,
    SceneUse,
)
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
from .geodesy import Datum, GeoPose
from .geometry import Camera, Quaternion, RigidTransform, Similarity
from .groups import (
    GroupRejected,
    ImageReport,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
    TrackingJump,
)
from .lenses import Fisheye, RadialTangential
from .masks import IgnoredMask
from .options import ConnectOptions
from .priors import GeoPositionPrior, GravityPrior, HeadingPrior, PosePrior, PositionPrior, Priors
from .provenance import Provenance, Voucher
from .requests import IntrinsicsUncertainty, NewReference, ReadoutDirection
from .results import Coverage, PendingWork, Reference, ReferenceAudit, RestoredReferences, RetrievedReference, Scene
from .scenes import UNCHANGED, AdoptionPolicy, Calibration
from .shortcut import localize
from .used_intrinsics import IntrinsicsCheck, UsedIntrinsics

__all__ = [
    "UNCHANGED",
    "Accuracy",
    "AdoptionPolicy",
    "AlreadyExists",
    "Attempt",
    "Calibration",
    "Camera",
    "Client",
    "ConnectOptions",
    "Coverage",
    "DataLoss",
    "Datum",
    "DeadlineExceeded",
    "Debug",
    "DepthCheck",
    "DepthImage",
    "DepthNoise",
    "DepthSensor",
    "Diagnostics",
    "FailedPrecondition",
    "Fisheye",
    "FramedPose",
    "GeoPose",
    "GeoPositionPrior",
    "GravityPrior",
    "GroupRejected",
    "HeadingPrior",
    "Hint",
    "Hypothesis",
    "IgnoredDepth",
    "IgnoredMask",
    "ImageReport",
    "Internal",
    "IntrinsicsCheck",
    "IntrinsicsUncertainty",
    "InvalidArgument",
    "LadderCut",
    "LocalizationResult",
    "MaplessError",
    "MissingEvidence",
    "NewReference",
    "NotFound",
    "PendingWork",
    "PermissionDenied",
    "PosePrior",
    "PositionPrior",
    "PriorCheck",
    "Priors",
    "Provenance",
    "Quaternion",
    "RadialTangential",
    "ReadoutDirection",
    "Reference",
    "ReferenceAudit",
    "ReferenceUse",
    "Rejected",
    "ResourceExhausted",
    "RestoredReferences",
    "RetrievedReference",
    "RigImage",
    "RigLocalization",
    "RigidTransform",
    "ScaleEstimate",
    "Scene",
    "SceneUse",
    "SequenceFrame",
    "SequenceLocalization",
    "Similarity",
    "TrackingJump",
    "Unauthenticated",
    "Unavailable",
    "UsedIntrinsics",
    "Voucher",
    "aio",
    "localize",
    "read_camera",
    "read_cameras",
    "read_pose",
]
