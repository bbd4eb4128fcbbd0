"""The report of the last weeks."""

from datetime import date, timedelta

from mapless import Client
from mapless.scene_reports import SceneReport


def report_of_weeks(client: Client, scene: str, weeks: int, last_day: date | None = None) -> SceneReport:
    """The report of so many weeks; they end with the last day or, if it is None, with today by the server's clock."""
    last = last_day or client.get_scene_report(scene, days_per_period=1).last_day
    return client.get_scene_report(scene, first_day=last - timedelta(days=7 * weeks - 1), last_day=last)
