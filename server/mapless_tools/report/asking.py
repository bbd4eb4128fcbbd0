"""The report of the last weeks."""

from datetime import date

from mapless import Client
from mapless.cli.report import days_of
from mapless.scene_reports import SceneReport


def report_of_weeks(
    client: Client, scene: str, weeks: int, last_day: date | None = None, first_day: date | None = None
) -> SceneReport:
    """The report of so many weeks, or from the first day on.

    They end with the last day or, if it is None, with today by the server's clock. ValueError for days after that.
    """
    today = client.get_scene_report(scene, days_per_period=1).last_day
    first, last = days_of(weeks, first_day, last_day, today)
    return client.get_scene_report(scene, first_day=first, last_day=last)
