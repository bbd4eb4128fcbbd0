"""Measures a constant again and writes its page: `PYTHONPATH=client:server python -m research.evidence KEY [SCENES]`.

SCENES is the folder of the scenes' folders, by default ../shared/data. Without a KEY it lists them.
"""

import importlib
import sys
from pathlib import Path

from .page import PAGES, page

MODULES = {
    "stationary": (
        "stationary-overlays",
        "stationary-contradicted-px",
        "stationary-support",
        "stationary-unmoved-px",
        "stationary-same-view-share",
    ),
    "stationary_auto": ("stationary-overlays-auto",),
    "one_place": ("same-place", "clearly-more"),
    "fairness": ("queue-credit", "queue-lately", "queue-client-share", "queue-failing", "queue-shorter"),
    "handshake": ("handshake",),
    "accused": ("accusation-chance",),
    "worth": ("rungs-worth", "place-agreement"),
    "any_roll": ("any-roll-pixels",),
    "network_matches": ("rematched-keypoints", "promising-matches"),
}
"""The keys that each module measures, by `measure(key, scenes)`, which returns the question and its rows."""


def main(arguments: list[str]) -> None:
    """Writes the page of the key in the arguments, or prints the keys."""
    module_of = {key: module for module, keys in MODULES.items() for key in keys}
    if not arguments or arguments[0] not in module_of:
        print("\n".join(module_of))
        sys.exit(0 if not arguments else 2)
    key, scenes = arguments[0], Path(arguments[1] if len(arguments) > 1 else "../shared/data")
    measured = importlib.import_module(f".{module_of[key]}", __package__)
    PAGES.mkdir(exist_ok=True)
    question, rows = measured.measure(key, scenes)
    value, done = question.value, []  # rows may set the constant
    for row in rows:
        print(*row.values(), sep=" | ", flush=True)
        done.append(row)
        # After each row: what is measured in many minutes may be stopped.
        (PAGES / f"{key}.md").write_text(page(question, value, done))


if __name__ == "__main__":
    main(sys.argv[1:])
