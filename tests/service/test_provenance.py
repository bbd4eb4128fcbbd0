"""How the pose of a reference is known, through a server: kept, audited, and refused by its field."""

import math

import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, Stubs, failure_of, pose

from mapless import Accuracy, Client, NewReference, Provenance
from mapless.requests import create_request
from mapless.v1 import reference_service_pb2 as pb
from mapless.v1.localization_service_pb2 import Accuracy as Accuracies

PLACED = Provenance("PLACED", Accuracy(0.01, 0.02, 0.3, 0.4), covariance=np.diag([1e-4] * 3 + [1e-5] * 3).tolist())


def new(provenance: Provenance = PLACED) -> NewReference:
    return NewReference("placed", PHOTO, CAMERA, pose(5.0), provenance=provenance)


def test_provenance_is_kept_with_its_reference(client: Client, scene: str) -> None:
    assert client.add_reference(scene, new()).provenance == PLACED
    listed = {it.reference_id: it.provenance for it in client.list_references(scene)}
    assert (listed["placed"], listed["r0"]) == (PLACED, Provenance())
    audits = {it.name.rpartition("/")[2]: it.provenance for it in client.audit_scene(scene)}
    assert (audits["placed"], audits["r0"]) == (PLACED, Provenance())


def test_a_given_pose_may_have_an_accuracy(client: Client, scene: str) -> None:
    surveyed = Provenance(accuracy=Accuracy(0.002, 0.004, 0.0, 0.0))
    assert client.add_reference(scene, new(surveyed)).provenance == surveyed


def covariance(diagonal: list[float], corner: float = 0.0, count: int = 36) -> pb.Provenance:
    """A given pose with radii, and so many numbers of a covariance with one entry off its diagonal."""
    matrix = np.diag(diagonal)
    matrix[0, 1] = corner
    wrong = pb.Provenance(accuracy=Accuracies(position_68_m=1.0, position_95_m=2.0))
    wrong.covariance.row_major.extend(matrix.ravel().tolist()[:count])
    return wrong


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        (pb.Provenance(source=7), "source"),  # type: ignore[arg-type]  # of a newer program
        (pb.Provenance(source=pb.POSE_SOURCE_PLACED), "accuracy"),
        ({"position_68_m": -1.0}, "accuracy.position_68_m"),
        ({"position_95_m": 0.5}, "accuracy.position_95_m"),
        ({"rotation_68_deg": math.nan}, "accuracy.rotation_68_deg"),
        ({"rotation_95_deg": math.inf}, "accuracy.rotation_95_deg"),
        ({"position_95_m": 1000.5}, "accuracy.position_95_m"),
        ({"rotation_95_deg": 180.5}, "accuracy.rotation_95_deg"),
        (covariance([1.0] * 6, count=35), "covariance"),
        (covariance([1.0] * 6, count=0), "covariance"),
        (covariance([1.0] * 6, corner=0.5), "covariance"),
        (covariance([1.0] * 5 + [-1.0]), "covariance"),
        (covariance([1.0] * 5 + [math.nan]), "covariance"),
        (covariance([1.1e6] + [1.0] * 5), "covariance"),
    ],
    ids=[
        "source",
        "missing",
        "negative",
        "smaller",
        "nan",
        "infinite",
        "1000m",
        "180deg",
        "few",
        "none",
        "asymmetric",
        "indefinite",
        "number",
        "km",
    ],
)
def test_a_wrong_provenance_is_refused_by_field(
    stubs: Stubs, scene: str, wrong: pb.Provenance | dict[str, float], field: str
) -> None:
    request = create_request(f"scenes/{scene}", new())
    if isinstance(wrong, pb.Provenance):
        request.reference.provenance.CopyFrom(wrong)
    else:
        for name, radius in {"position_68_m": 1.0, "position_95_m": 2.0, **wrong}.items():
            setattr(request.reference.provenance.accuracy, name, radius)
    error = failure_of(stubs.references.CreateReference, request)
    assert (error.code, error.field) == ("INVALID_ARGUMENT", f"reference.provenance.{field}")
