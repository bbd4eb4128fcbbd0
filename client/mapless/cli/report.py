"""The command `mapless scene report`: how photographs of a scene were answered, and what would help."""

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import date, timedelta
from textwrap import wrap

from ..client import Client
from ..rejections import WORDS, explained
from ..scene_reports import PeriodCounts, PlaceReport, ReferenceEvent, SceneReport
from .folder import EXIT_REJECTED
from .output import card, show, table

DEFAULT_WEEKS, MOST_WEEKS = 4, 500
WORST_PLACES, SUGGESTIONS, NAMED_PLACES, EVENTS = 5, 3, 10, 10
"""Places, suggestions and retired references that are printed; JSON has all."""
JUDGED_DAYS, LEAST_PHOTOGRAPHS = 7, 50
"""A share of localized photographs is judged of the last so many days, if they have so many photographs, as by the
alert MaplessSceneAges."""
EPOCH = date(1970, 1, 1)
WIDTH = 100
"""Characters of a line of a suggestion."""


def add_report(actions: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the action and its flags."""
    report = actions.add_parser(
        "report",
        help="how its photographs were answered, week by week, and what would help",
        description="Photographs by week and reason, the places with most rejections, places that need a new survey, "
        "what was adopted and retired, and where references would help most. Days are UTC. Exit code 0; with "
        "--alert-below 3 if there is something to do, which the text says first.",
    )
    report.add_argument("scene")
    begin = report.add_mutually_exclusive_group()
    begin.add_argument("--weeks", type=_weeks, metavar="N", help=f"so many weeks (default: {DEFAULT_WEEKS})")
    begin.add_argument("--since", type=day_of, metavar="DAY", help="first day, such as 2026-11-02, instead of --weeks")
    report.add_argument(
        "--until", type=day_of, metavar="DAY", help="last day, at most today, by the server's clock (default)"
    )
    report.add_argument("--by-day", action="store_true", help="count days instead of weeks")
    report.add_argument(
        "--alert-below",
        type=_share,
        metavar="SHARE",
        help=f"exit code 3 if a smaller share of the last {JUDGED_DAYS} days' photographs is localized, where they are "
        f"{LEAST_PHOTOGRAPHS} or more, or a place needs a new survey",
    )
    report.set_defaults(run=scene_report)


def _weeks(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MOST_WEEKS:
        raise argparse.ArgumentTypeError(f"must be 1 to {MOST_WEEKS}, is {text!r}")
    return int(text)


def day_of(text: str) -> date:
    """A day of a flag; ArgumentTypeError names a wrong one."""
    try:
        day = date.fromisoformat(text)
        if text != day.isoformat():  # Python 3.11 takes more than 3.10
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no day such as 2026-11-02") from None
    if day < EPOCH:
        raise argparse.ArgumentTypeError(f"must be {EPOCH} or later, is {day}")
    return day


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
    if first_day is not None or last_day is not None or arguments.weeks is not None or arguments.by_day:
        today = client.get_scene_report(arguments.scene, days_per_period=1).last_day
        first_day, last_day = days_of(arguments.weeks or DEFAULT_WEEKS, first_day, last_day, today)
    report = client.get_scene_report(
        arguments.scene,
        first_day=first_day,
        last_day=last_day,
        days_per_period=1 if arguments.by_day else 7,
    )
    to_do = [] if arguments.alert_below is None else work_of(report, arguments.alert_below)
    show(arguments, report, report_text(report, to_do))
    return EXIT_REJECTED if to_do else 0


def days_of(weeks: int, since: date | None, until: date | None, today: date) -> tuple[date, date]:
    """First and last day of a report: so many weeks, or from a day on, until today, the server's day, or before.

    ValueError names the flag of a day after today. The first is at the earliest the first that a report can have.
    """
    for flag, day in (("--since", since), ("--until", until)):
        if day is not None and day > today:
            raise ValueError(f"{flag} {day} is after today, {today} by the server's clock (UTC)")
    last_day = until or today
    return since or last_day - timedelta(min(7 * weeks - 1, (last_day - EPOCH).days)), last_day


def work_of(report: SceneReport, least_localized_share: float) -> list[str]:
    """Why something has to be done, a phrase each; empty if nothing has to be.

    A smaller share of the last days' photographs is localized, where they are enough, or places need a new survey.
    """
    found = list[str]()
    days = min(JUDGED_DAYS, (report.last_day - report.first_day).days + 1)
    last = [it for it in report.periods if it.last_day > report.last_day - timedelta(days)]
    count, localized = sum(it.photograph_count for it in last), sum(it.localized_count for it in last)
    if count >= LEAST_PHOTOGRAPHS and localized < least_localized_share * count:
        share, least = percent(localized / count), percent(least_localized_share)
        found.append(f"{share} of the last {days} days' {count} photographs were localized, less than {least}")
    if outdated := sum(it.is_outdated for it in report.places):
        found.append("a place needs a new survey" if outdated == 1 else f"{outdated} places need a new survey")
    return found


def report_text(report: SceneReport, to_do: Sequence[str] = ()) -> list[str]:
    """Lines of the report for a person; what is to do comes first."""
    lines = [f"{report.scene_id}, {report.first_day} to {report.last_day} (UTC)"]
    if to_do:
        lines += ["", *wrap(f"To do: {'; '.join(to_do)}", WIDTH, subsequent_indent="       ")]
    counted = any(it.photograph_count for it in report.periods)
    lines += ["", *(_periods(report) if counted else ["no photographs were counted"])]
    rejecting = sorted((it for it in report.places if rejected_count(it)), key=rejected_count, reverse=True)
    if rejecting:
        lines += ["", "Where photographs are rejected:", *_worst(rejecting)]
    if outdated := [named_place(it) for it in report.places if it.is_outdated]:
        named = _first(outdated, NAMED_PLACES)
        lines += ["", *wrap(f"Places that need a new survey: {named}", WIDTH, subsequent_indent="   ")]
    if adoption := _adoption(report):
        lines += ["", *adoption]
    if retired := [it for it in reversed(report.events) if it.kind == "RETIRED"]:
        lines += ["", "Retired references:", *_retired(retired)]
    if report.suggestions:
        lines += ["", "What would help most:"]
        for i, it in enumerate(report.suggestions[:SUGGESTIONS], 1):
            lines += wrap(f"{i}. {it.message}", WIDTH, subsequent_indent="   ")
        if (more := len(report.suggestions) - SUGGESTIONS) > 0:
            lines.append(f"and {more} more")
        lines += ["Photographs of elsewhere look as if references were missing: see whether any come from there."]
    if found := [it for it in rejections_of(report.periods) if it in WORDS]:
        lines += ["", *map(explained, found)]
    return lines


def named_place(place: PlaceReport) -> str:
    """A place by its reference, and where that is, if it is known."""
    if place.world_from_camera is None:
        return place.reference_id
    x, y, z = place.world_from_camera.translation.tolist()
    return f"{place.reference_id} at ({x:.2f}, {y:.2f}, {z:.2f})"


def _first(names: Sequence[str], most: int) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def _retired(events: Sequence[ReferenceEvent]) -> list[str]:
    rows = [(it.reference_id, it.message.removeprefix("retired on ")) for it in events[:EVENTS]]
    more = len(events) - EVENTS
    return [*table(("REFERENCE", "RETIRED ON"), rows), *([f"and {more} more before"] if more > 0 else [])]


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
    """The most frequent reasons of rejections, with their numbers, and the number of all others together."""
    found = sorted(rejections.items(), key=lambda it: (-it[1], it[0]))
    others = sum(count for _, count in found[most:])
    return ", ".join([f"{reason} {count}" for reason, count in found[:most]] + [f"others {others}"] * bool(others))


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
        **{"not adopted": reasons(adoptions, len(adoptions)) or None},
        retired=f"{retirements.total()} by servers ({reasons(retirements, len(retirements))})" if retirements else None,
    )
