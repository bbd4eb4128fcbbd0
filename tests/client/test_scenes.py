"""What is said of a scene as a whole, as messages: what the proto says is ignored may be anything."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapless.scenes import Calibration, unit_vector
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.services.messages.references import changes_from_message


@pytest.mark.parametrize("seconds", [0, 1, 10**15, -(10**15)])
def test_the_caller_does_not_set_when_a_calibration_was_stored(seconds: int) -> None:
    calibration = pb.SceneCalibration(
        position_factor_68=1.0,
        position_factor_95=1.5,
        rotation_factor_68=1.0,
        rotation_factor_95=2.0,
        query_count=7,
        variant=localization_pb.VARIANT_BEST,
    )
    calibration.create_time.seconds = seconds
    request = pb.UpdateSceneRequest(scene=pb.Scene(name="scenes/hall", calibration=calibration))
    request.update_mask.paths.append("calibration")
    changes = changes_from_message(request)
    stored = changes["calibration"]
    assert isinstance(stored, Calibration)
    assert (stored.create_time, stored.query_count, stored.rotation_factor_95) == (None, 7, 2.0)
    assert request.scene.calibration.create_time.seconds == seconds  # the request itself is left alone


@settings(deadline=None)
@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3))
def test_directions_are_of_unit_length_whatever_they_were(vector: tuple[float, float, float]) -> None:
    """Also of vectors whose squares are no numbers."""
    if not any(vector):
        with pytest.raises(ValueError, match="not zero"):
            unit_vector(*vector)
        return
    found = np.array(unit_vector(*vector))
    assert np.linalg.norm(found) == pytest.approx(1)
    largest = np.abs(vector).max()
    np.testing.assert_allclose(
        found * np.linalg.norm(np.array(vector) / largest), np.array(vector) / largest, atol=1e-12
    )
