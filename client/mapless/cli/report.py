"""The command `mapless scene report`: how photographs of a scene were answered, and what would help."""

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping
from datetime import date, timedelta
from textwrap import wrap

from ..client import Client
from ..scene_reports import PeriodCounts, PlaceReport, SceneReport
from .folder import EXIT_REJECTED
from .output import card, show, table

DEFAULT_WEEKS, MOST_WEEKS = 4, 500
WORST_PLACES, SUGGESTIONS, NAMED_PLACES = 5, 3, 10
"""Places and suggestions that are printed; JSON has all."""
WIDTH = 100
"""Characters of a line of a suggestion."""


def add_report(actions: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the action and its flags."""
    report = actions.add_parser(
        "report",
        help="how its photographs were answered, week by week, and what would help",
        description="Photographs by week and reason, the places with most rejections, places that need a new survey, "
        "what was adopted and retired, and where references would help most. Days are UTC. Exit code 0; with "
        "--alert-below 3 if there is something to do.",
    )
    report.add_argument("scene")
    begin = report.add_mutually_exclusive_group()
    begin.add_argument(
        "--weeks", type=_weeks, default=DEFAULT_WEEKS, metavar="N", help=f"so many weeks (default: {DEFAULT_WEEKS})"
    )
    begin.add_argument("--since", type=_day, metavar="DAY", help="first day, such as 2026-11-02, instead of --weeks")
    report.add_argument("--until", type=_day, metavar="DAY", help="last day (default: today)")
    report.add_argument("--by-day", action="store_true", help="count days instead of weeks")
    report.add_argument(
        "--alert-below",
        type=_share,
        metavar="SHARE",
        help="exit code 3 if a smaller share of the last week is localized, or a place needs a new survey",
    )
    report.set_defaults(run=scene_report)


def _weeks(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MOST_WEEKS:
        raise argparse.ArgumentTypeError(f"must be 1 to {MOST_WEEKS}, is {text!r}")
    return int(text)


def _day(text: str) -> date:
    try:
        return date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no day such as 2026-11-02") from None


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0 <= share <= 1:
        raise argparse.ArgumentTypeError(f"must be 0 to 1, is {text!r}")
    return share


def scene_report(client: Client, arguments: argparse.Namespace) -> int:
    """Prints the report; exit code 3 where it asks for something to be done, with --alert-below."""
    first_day, last_day = arguments.since, arguments.until
    if first_day is not None and last_day is not None and first_day > last_day:
        raise ValueError(f"--since {first_day} is after --until {last_day}")
    if first_day is None and (last_day is not None or arguments.weeks != DEFAULT_WEEKS or arguments.by_day):
        latest = last_day or client.get_scene_report(arguments.scene, days_per_period=1).last_day  # by its clock
        first_day, last_day = latest - timedelta(days=7 * arguments.weeks - 1), latest
    report = client.get_scene_report(
        arguments.scene,
        first_day=first_day,
        last_day=last_day,
        days_per_period=1 if arguments.by_day else 7,
    )
    show(arguments, report, report_text(report))
    return EXIT_REJECTED if arguments.alert_below is not None and needs_work(report, arguments.alert_below) else 0


def needs_work(report: SceneReport, least_localized_share: float) -> bool:
    """Whether fewer photographs of the last period are localized, or a place needs a new survey."""
    share = report.periods[-1].localized_share
    return any(it.is_outdated for it in report.places) or (share is not None and share < least_localized_share)


def report_text(report: SceneReport) -> list[str]:
    """Lines of the report for a person."""
    lines = [f"{report.scene_id}, {report.first_day} to {report.last_day} (UTC)", ""]
    if not any(it.photograph_count for it in report.periods):
        return [*lines, "no photographs were counted"]
    lines += _periods(report)
    rejecting = sorted((it for it in report.places if rejected_count(it)), key=rejected_count, reverse=True)
    if rejecting:
        lines += ["", "Where photographs are rejected:", *_worst(rejecting)]
    outdated = [it.reference_id for it in report.places if it.is_outdated]
    if outdated:
        more = f" and {len(outdated) - NAMED_PLACES} more" if len(outdated) > NAMED_PLACES else ""
        lines += ["", f"Places that need a new survey: {', '.join(outdated[:NAMED_PLACES])}{more}"]
    if adoption := _adoption(report):
        lines += ["", *adoption]
    if report.suggestions:
        lines += ["", "What would help most:"]
        for i, it in enumerate(report.suggestions[:SUGGESTIONS], 1):
            lines += wrap(f"{i}. {it.message}", WIDTH, subsequent_indent="   ")
    return lines


def _periods(report: SceneReport) -> list[str]:
    has_adopted = any(it.surveyed_share is not None and it.surveyed_share < 1 for it in report.periods)
    head = ["FROM", "PHOTOGRAPHS", "LOCALIZED", "68 % WITHIN", "INLIERS", *(["SURVEYED"] * has_adopted), "REJECTED"]
    rows = []
    for it in report.periods:
        inliers = "" if it.inlier_count is None else f"{it.inlier_count:.0f}"
        numbers = [percent(it.localized_share), _radius(it, report.arbitrary_unit), inliers]
        numbers += [percent(it.surveyed_share)] * has_adopted
        aligned = [text.rjust(len(name)) for text, name in zip(numbers, head[2:], strict=False)]
        rows.append([f"{it.first_day}", it.photograph_count, *aligned, reasons(it.rejections)])
    return table(head, rows)


def _radius(it: PeriodCounts, arbitrary_unit: bool) -> str:
    if it.position_68_m is None:
        return ""
    return f"{it.position_68_m:.3g} units" if arbitrary_unit else f"{100 * it.position_68_m:.1f} cm"


def percent(share: float | None) -> str:
    """A share for a person; empty if it is not known."""
    return "" if share is None else f"{100 * share:.0f} %"


def reasons(rejections: Mapping[str, int], most: int = 3) -> str:
    """The most frequent reasons of rejections, with their numbers."""
    found = sorted(rejections.items(), key=lambda it: (-it[1], it[0]))
    return ", ".join(f"{reason} {count}" for reason, count in found[:most])


def rejections_of(periods: Iterable[PeriodCounts]) -> Counter[str]:
    """Number of rejected photographs of all periods, by reason."""
    found = Counter[str]()
    for it in periods:
        found.update(it.rejections)
    return found


def rejected_count(place: PlaceReport) -> int:
    """Photographs of a place that were rejected."""
    return sum(it.rejected_count for it in place.periods)


def _worst(places: list[PlaceReport]) -> list[str]:
    rows = []
    for it in places[:WORST_PLACES]:
        of = sum(each.photograph_count for each in it.periods)
        left = "" if it.state is None else percent(it.state.surveyed_share)
        why = reasons(rejections_of(it.periods), 2)
        rows.append((it.reference_id or "(unknown)", rejected_count(it), of, left, it.adopted_count, why))
    more = len(places) - WORST_PLACES
    lines = table(("PLACE OF", "REJECTED", "OF", "SURVEY LEFT", "ADOPTED", "WHY"), rows)
    return [*lines, f"and {more} more places"] if more > 0 else lines


def _adoption(report: SceneReport) -> list[str]:
    """Lines about what was adopted and retired, and why not; empty if nothing was considered."""
    adoptions, retirements = Counter[str](), Counter[str]()
    for it in report.periods:
        adoptions.update(it.adoptions)
        retirements.update(it.retirements)
    adopted = adoptions.pop("adopted", 0)
    considered = bool(adopted or adoptions)
    return card(
        adopted=adopted if considered else None,
        **{"not adopted": reasons(adoptions) or None},
        retired=f"{retirements.total()} ({reasons(retirements)})" if retirements else None,
    )
