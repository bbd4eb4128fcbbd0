"""`python -m mapless_tools.planning FOLDER`: draws the curves into the folder, and prints their figures."""

from __future__ import annotations

import sys
from pathlib import Path

from .city import City
from .curves import charts, svg


def main(arguments: list[str]) -> int:
    """Exit code: 0, or 2 where no folder is named."""
    if len(arguments) != 1:
        print("usage: python -m mapless_tools.planning FOLDER", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, chart in charts(City()):
        (folder / f"{name}.svg").write_text(svg(chart), encoding="utf-8")
        print(f"{name}: {chart.y.label} against {chart.x.label}")
        for curve in chart.curves:
            print(f"  {curve.name}: " + ", ".join(f"{x:g}: {y:.4g}" for x, y in curve.points))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
