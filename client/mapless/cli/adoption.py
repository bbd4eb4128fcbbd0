"""Flags and commands about photographs that become references, and references that are retired."""

import argparse
from dataclasses import replace
from datetime import datetime, timezone

from ..client import Client
from ..results import Reference
from ..scenes import AdoptionPolicy
from .folder import EXIT_FAILED
from .output import is_confirmed, show, table

_POLICY = "values that are not given stay as the scene has them, at first the defaults"
_FORGOTTEN = "what photographs said of places that needed a new survey is forgotten"


def add_policy(command: argparse.ArgumentParser) -> None:
    """Adds the flags that `policy_of` reads."""
    group, default = command.add_argument_group("adoption", _POLICY), AdoptionPolicy()
    group.add_argument(
        "--adopt", action="store_true", help="localized photographs whose requests allow it become references"
    )
    for flag, kind, unit, text in (
        ("most", int, "N", f"most adopted references at a place (default: {default.most_per_place})"),
        ("trust", float, "TRUST", f"least trust of an answer, above 0 (default: {default.min_trust:g})"),
        ("radius", float, "M", f"largest 68 %% radius, m (default: {default.radius_m:g}) or the scene's unit"),
        ("surveyed", float, "SHARE", f"least share of surveyed matches (default: {default.min_surveyed_share:g})"),
    ):
        group.add_argument(f"--adopt-{flag}", type=kind, metavar=unit, help=text)


def policy_of(
    arguments: argparse.Namespace, current: AdoptionPolicy | None = None, new_unit: str = ""
) -> AdoptionPolicy | None:
    """The adoption policy that the flags give, with the `current` one's other values; None without `--adopt`.

    ValueError for a value that is out of bounds, or without `--adopt`; and without a radius where it has a new unit, in
    which neither the default nor the current one is.
    """
    given = {
        "most_per_place": arguments.adopt_most,
        "min_trust": arguments.adopt_trust,
        "max_radius_m": arguments.adopt_radius,
        "min_surveyed_share": arguments.adopt_surveyed,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if arguments.adopt and new_unit and arguments.adopt_radius is None:
        raise ValueError(f"the scene's unit is {new_unit}: give the largest 68 % radius in it, --adopt-radius")
    if arguments.adopt:
        return replace(current or AdoptionPolicy(), **given)
    if given:
        raise ValueError("--adopt-most, --adopt-trust, --adopt-radius and --adopt-surveyed need --adopt")
    return None


def policy_text(policy: AdoptionPolicy | None, unit: str) -> str | None:
    """A sentence about the adoption of a scene with this unit of length; None if it adopts nothing."""
    if policy is None:
        return None
    share = f"{100 * policy.min_surveyed_share:.0f} % surveyed"
    return (
        f"at most {policy.most_per_place} a place, trust {policy.min_trust:g}, "
        f"within {policy.radius_m:g} {unit} (68 %), {share}"
    )


def add_actions(actions: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Adds the actions of references that undo what the server did by itself."""
    retire = actions.add_parser("retire", help="have one not chosen for photographs any more")
    retire.add_argument("scene")
    retire.add_argument("reference")
    retire.set_defaults(run=retire_reference)
    restore = actions.add_parser(
        "restore",
        help="have a retired one chosen again, or all, or some",
        description=f"With --all, and at the place of --place, {_FORGOTTEN}, "
        "and so the evidence that these are outdated. Where that is right, use --since alone.",
    )
    restore.add_argument("scene")
    restore.add_argument("reference", nargs="?", default="")
    restore.add_argument("--all", action="store_true", help="all retired ones of the scene")
    restore.add_argument("--place", default="", metavar="REFERENCE", help="this surveyed one, and those adopted there")
    restore.add_argument("--since", type=_time, metavar="TIME", help="those retired since, such as 2026-11-29, UTC")
    restore.set_defaults(run=restore_references)
    undo = actions.add_parser("undo-adoption", help="delete those that were adopted since a time")
    undo.add_argument("scene")
    undo.add_argument(
        "--since", required=True, type=_time, metavar="TIME", help="such as 2026-11-29 or 2026-11-29T18:00, UTC"
    )
    undo.add_argument("--yes", action="store_true", help="do not ask; only a terminal is asked")
    undo.set_defaults(run=undo_adoption)


def _time(text: str) -> datetime:
    try:
        found = datetime.fromisoformat(text)
        if not text.startswith(f"{found:%Y-%m-%d}"):  # Python 3.11 takes more than 3.10
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no time such as 2026-11-29T18:00") from None
    return found.replace(tzinfo=timezone.utc) if found.tzinfo is None else found


def retire_reference(client: Client, arguments: argparse.Namespace) -> int:
    """Has a reference not chosen any more."""
    found = client.retire_reference(arguments.scene, arguments.reference)
    return show(arguments, found, [f"{found.reference_id} is not chosen for photographs any more"])


def restore_references(client: Client, arguments: argparse.Namespace) -> int:
    """Has retired references chosen again: one, all, or those of a place or since a time."""
    some = {"--place": bool(arguments.place), "--since": arguments.since is not None}
    narrowing = [flag for flag, is_given in some.items() if is_given]
    given = ["REFERENCE"] * bool(arguments.reference) + ["--all"] * arguments.all + narrowing
    if not given:
        raise ValueError("which ones? Give a REFERENCE, or --place, --since or both, or --all")
    if len(given) > 1 and given != narrowing:
        raise ValueError(f"{given[0]} does not go together with {' and '.join(given[1:])}")
    if not arguments.reference:
        done = client.restore_references(arguments.scene, since=arguments.since, place=arguments.place)
        ids, still = done.reference_ids, done.still_retired
        lines = [f"{_number(len(ids))} chosen for photographs again", *(f"  {it}" for it in ids)]
        if arguments.place or arguments.since is None:
            lines.append(_FORGOTTEN)
        if still:
            lines += [f"{_number(len(still))} still retired", *(f"  {it}: {why}" for it, why in still.items())]
        return show(arguments, done, lines)
    was_retired = client.get_reference(arguments.scene, arguments.reference).retire_time is not None
    found = client.restore_reference(arguments.scene, arguments.reference)
    text = "is chosen for photographs again" if was_retired else "was not retired"
    return show(arguments, found, [f"{found.reference_id} {text}"])


def _number(count: int, what: str = "reference") -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def undo_adoption(client: Client, arguments: argparse.Namespace) -> int:
    """Deletes what was adopted since a time; exit code 1 if the user, asked, does not want it."""
    if not is_confirmed(arguments, f"delete what {arguments.scene} has adopted since {arguments.since.isoformat()}"):
        return EXIT_FAILED
    gone = client.undo_adoption(arguments.scene, arguments.since)
    number = _number(len(gone), "adopted reference")
    return show(arguments, gone, [f"{number} deleted", *(f"  {it.reference_id}" for it in gone)])


def adopted_table(references: list[Reference]) -> list[str]:
    """A table of adopted references, with what vouches for them."""
    rows = []
    for it in references:
        vouchers = ", ".join(one.reference_id for one in it.provenance.vouchers[:3])
        share = f"{100 * it.provenance.surveyed_share:.0f} %"
        adopted = it.provenance.adopt_time or it.create_time
        rows.append((it.reference_id, it.place_reference, share, vouchers, f"{adopted:%Y-%m-%d %H:%M}", _retired(it)))
    return table(("REFERENCE", "PLACE OF", "SURVEYED", "VOUCHERS", "ADOPTED", "RETIRED ON"), rows)


def _retired(it: Reference) -> str:
    return it.retirement.removeprefix("retired on ")


def retired_table(references: list[Reference]) -> list[str]:
    """A table of retired references, with why."""
    return table(("REFERENCE", "RETIRED ON"), [(it.reference_id, _retired(it)) for it in references])


def places_table(references: list[Reference]) -> list[str]:
    """A table of the places that photographs were considered of, those with the least survey left first."""
    seen = [(it.place, it.reference_id) for it in references if it.place is not None]
    rows = [
        (
            name,
            f"{100 * it.surveyed_share:.0f} %",
            it.photograph_count,
            it.contradiction_count,
            "outdated" if it.is_outdated else "",
        )
        for it, name in sorted(seen, key=lambda both: (both[0].surveyed_share, both[1]))
    ]
    return table(("PLACE OF", "SURVEY LEFT", "PHOTOGRAPHS", "CONTRADICTIONS", ""), rows)
