"""`python -m bench.load_ray overhead|throughput|failover|redeploys|all`: prints tables, writes JSON."""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.load.overhead import overhead_figures, overhead_lines
from bench.load.report import Check, report_part
from mapless_server.serve.signals import terminable
from mapless_tools.demo import place_of
from mapless_tools.progress import Progress, progress_bars

from .cluster import ClusterFailed
from .database import NoDatabase
from .overhead import OPTIONS, measure_overhead, overhead_checks
from .replacing import failover_checks, kill_one, measure_replacements, redeploy, redeploys_checks, replacement_lines
from .throughput import ThroughputOptions, measure_throughput, throughput_checks, throughput_lines

KILLS, REDEPLOYS = 10, 20
Part = tuple[list[str], list[Check], dict[str, Any]]
"""Printed lines, checks, and the figures for programs."""


def overhead(given: argparse.Namespace, progress: Progress) -> Part:
    """Measures the cost of the ingress."""
    options = replace(OPTIONS, rounds=2, unloaded_s=0.5, saturated_s=0.5) if given.quick else OPTIONS
    ways = measure_overhead(options, progress)
    return overhead_lines(ways, options), overhead_checks(ways), overhead_figures(ways, options)


def throughput(given: argparse.Namespace, progress: Progress) -> Part:
    """Measures the throughput of two replicas and of one."""
    options = ThroughputOptions(rounds=1, step_s=5.0) if given.quick else ThroughputOptions()
    place = place_of(given.data)
    rounds = measure_throughput(place, options, progress)
    return throughput_lines(rounds, place, options), throughput_checks(rounds), {"options": options, "rounds": rounds}


def failover(given: argparse.Namespace, progress: Progress) -> Part:
    """Measures kills of one replica."""
    result = measure_replacements(kill_one, given.count or (2 if given.quick else KILLS), "failover", progress)
    return replacement_lines(result, "of which one is killed"), failover_checks(result), vars(result)


def redeploys(given: argparse.Namespace, progress: Progress) -> Part:
    """Measures replacements of all replicas."""
    result = measure_replacements(redeploy, given.count or (1 if given.quick else REDEPLOYS), "redeploys", progress)
    return replacement_lines(result, "replaced one after the other"), redeploys_checks(result), vars(result)


PARTS: dict[str, Callable[[argparse.Namespace, Progress], Part]] = {
    "overhead": overhead,
    "throughput": throughput,
    "failover": failover,
    "redeploys": redeploys,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the measurements; returns exit code 1 if a check failed or the cluster did not start."""
    parser = argparse.ArgumentParser(prog="python -m bench.load_ray", description=__doc__)
    parser.add_argument("part", choices=[*PARTS, "all"])
    parser.add_argument("--count", type=int, help=f"kills or redeploys; default: {KILLS} and {REDEPLOYS}")
    parser.add_argument("--data", type=Path, help="folder with images/ and cameras.json; default: the demo's room")
    parser.add_argument("--quick", action="store_true", help="to see that it runs; not for figures")
    parser.add_argument("--output", type=Path, default=Path("load-output"), help="folder for the figures")
    given = parser.parse_args(arguments)
    is_met = True
    try:
        with terminable(), progress_bars() as progress:
            for name in PARTS if given.part == "all" else (given.part,):
                lines, checks, figures = PARTS[name](given, progress)
                report_part(given.output / "load-ray.json", name, lines, checks, figures)
                is_met &= all(check.met for check in checks)
    except (ClusterFailed, NoDatabase, ValueError) as error:
        print(f"bench.load_ray: {error}", file=sys.stderr)
        return 1
    return 0 if is_met else 1


if __name__ == "__main__":
    sys.exit(main())
