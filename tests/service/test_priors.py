"""Soft priors through a real server: the scene attributes that they need, and how they narrow the choice."""

import numpy as np
import pytest
from support.servers import CAMERA, PHOTO, pose

from mapless import Client, InvalidArgument, LocalizationResult, NewReference, PositionPrior, Priors, Rejected
from mapless.geodesy import Datum, geodetic_from_world
from mapless.priors import GeoPositionPrior, GravityPrior

DATUM = Datum(47.3769, 8.5417, 450.0)
GRAVITY = Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), sigma_deg=1.0))
SATELLITE = Priors(geo_position=GeoPositionPrior(47.3769, 8.5417, horizontal_sigma_m=4.0))


@pytest.mark.parametrize(
    ("priors", "field"),
    [(GRAVITY, "gravity_prior.down_in_world"), (SATELLITE, "geo_position_prior")],
    ids=["gravity", "satellites"],
)
def test_what_the_scene_must_say_for_a_prior_is_named(client: Client, scene: str, priors: Priors, field: str) -> None:
    with pytest.raises(InvalidArgument) as caught:
        client.localize(PHOTO, CAMERA, scene, priors=priors)
    assert caught.value.field == field
    client.update_scene(scene, datum=DATUM)
    assert isinstance(client.localize(PHOTO, CAMERA, scene, priors=priors), LocalizationResult)


def test_satellites_and_a_covariance_narrow_the_choice_alike(client: Client) -> None:
    """Four standard deviations of half a metre and ten metres around x = 4 m; height unknown."""
    client.create_scene("square", datum=DATUM)
    client.add_references("square", [NewReference(f"x{x}", PHOTO, CAMERA, pose(float(x))) for x in (0, 8, 15, 40)])
    there = geodetic_from_world(pose(4.0).translation, DATUM)
    satellites = GeoPositionPrior(there.latitude_deg, there.longitude_deg, horizontal_sigma_m=0.5)
    likely = PositionPrior(pose(4.0).translation, covariance_m2=0.5**2 * np.eye(3))
    for priors in (Priors(geo_position=satellites), Priors(likely)):
        answer = client.localize(PHOTO, CAMERA, "square", priors=priors)
        assert {use.name.rpartition("/")[2] for use in answer.diagnostics.references} == {"x0", "x8", "x15"}
    nowhere = client.localize(PHOTO, CAMERA, "square", priors=Priors(PositionPrior(np.array([1e6, 0, 0]), 3.0)))
    assert isinstance(nowhere, Rejected)
    assert (nowhere.reason, nowhere.message) == ("NO_USABLE_REFERENCES", "no reference is where the prior says")
    client.delete_scene("square")
