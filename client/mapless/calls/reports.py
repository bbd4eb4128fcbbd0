"""Reports of how photographs of scenes were answered."""

from datetime import date
from typing import Any

from .. import wire
from ..connection import Connection
from ..names import scene_name
from ..scene_reports import SceneReport, report_from_message
from ..v1 import reference_service_pb2 as pb


async def get_scene_report(
    connection: Connection,
    scene: str,
    *,
    first_day: date | None = None,
    last_day: date | None = None,
    days_per_period: int = 7,
    timeout_s: float | None = None,
) -> SceneReport:
    """Reports how photographs of a scene were answered, by day, place and reason, and where references would help.

    What was answered in the last seconds may be missing, and confidential requests are.

    Args:
        scene: the scene.
        first_day: UTC; None such that there are four periods.
        last_day: UTC, less than 4000 days later; None for today, by the server's clock. Days to come have no
            photographs; the command line refuses them.
        days_per_period: days that are counted together, 1 to 366; the last period ends with the last day.
        timeout_s: deadline of the call.
    """
    request = pb.GetSceneReportRequest(
        scene=scene_name(scene),
        first_day=_text(first_day, "first_day"),
        last_day=_text(last_day, "last_day"),
    )
    wire.set_numbers(request, {"days_per_period": days_per_period})
    return await connection.call("GetSceneReport", request, _report, timeout_s)


def _text(day: date | None, name: str) -> str:
    """The day as in requests; TypeError for anything but a date, of which a time has another text."""
    if day is None:
        return ""
    wire.require(day, date, name)
    return f"{day:%Y-%m-%d}"


def _report(response: Any) -> SceneReport:
    return report_from_message(response.report)
