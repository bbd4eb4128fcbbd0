"""Measures a constant again and writes the table of its page: `make evidence KEY=KEY DATA=SCENES`."""

import argparse
import importlib
import tempfile
from pathlib import Path

import numpy as np

from research.places import Scenes

from .page import PAGES, Measurement, rewritten

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
    "mask_margin": ("mask-margin",),
    "parallax": ("parallax",),
    "scene_agreement": ("scene-agreement",),
    "rungs": ("rungs",),
    "readings": ("readings", "suspects"),
    "first_answers": ("few-references", "first-answers"),
    "depth_errors": ("depth-errors",),
    "rolling_shutter": ("rolling-shutter",),
    "depth_scores": ("depth-scores", "depth-radius"),
    "adopting": ("adoption-matches", "adoption-rivals", "adoption-contradictions"),
    "new_things": ("adoption-novelty",),
    "witnesses": ("adoption-witnesses", "adoption-outdated"),
    "suggesting": ("suggestion-half-life", "suggestion-least"),
    "retrieval_lists": ("retrieval-lists",),
    "scenes_tried": ("scenes-tried",),
    "network_matches": ("rematched-keypoints", "promising-matches"),
}
"""The keys of each module, by its MEASUREMENTS; a module is imported when one of them is measured."""
KEYS = tuple(key for keys in MODULES.values() for key in keys)
DATA = Path(__file__).parents[3].parent / "shared" / "data"


def measurement_of(key: str) -> Measurement:
    """How a key is measured."""
    (module,) = (module for module, keys in MODULES.items() if key in keys)
    found: Measurement = importlib.import_module(f"research.evidence.{module}").MEASUREMENTS[key]
    return found


def sampled(scenes: Path, count: int, folder: Path) -> Path:
    """A folder with links to so many of the scenes, evenly spread by their names."""
    names = Scenes(scenes).names
    for i in np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)):
        link = folder / names[i]
        link.parent.mkdir(exist_ok=True)
        link.symlink_to((scenes / names[i]).resolve())
    return folder


def main() -> None:
    """Measures a key, or prints the keys; wrong usage, and a folder that lacks scenes, end with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m research.evidence", description=__doc__)
    parser.add_argument("key", nargs="?", choices=KEYS, metavar="KEY", help="without one, the keys are printed")
    parser.add_argument("scenes", nargs="?", type=Path, default=DATA, help="folder of the scenes' folders")
    parser.add_argument("--sample", type=int, metavar="N", help="measure N of the scenes, evenly spread by their names")
    parser.add_argument("--print", action="store_true", help="print the table and leave the page as it is")
    arguments = parser.parse_args()
    if arguments.key is None:
        print("\n".join(KEYS))
        return
    key, scenes = arguments.key, arguments.scenes
    if arguments.sample is not None and arguments.sample < 1:
        parser.error(f"--sample must be at least 1, is {arguments.sample}")
    measurement, page = measurement_of(key), PAGES / f"{key}.md"
    if not page.is_file():
        parser.error(f"write the question, data and decision first: {page} does not exist")
    if measurement.needs_scenes and next(scenes.glob("**/cameras.json"), None) is None:
        parser.error(f"{scenes} has no scenes, folders with images/ and cameras.json")
    rows = []
    try:
        with tempfile.TemporaryDirectory() as linked:
            measured = scenes if arguments.sample is None else sampled(scenes, arguments.sample, Path(linked))
            for row in measurement.rows(measured):
                print(*row.values(), sep=" | ", flush=True)
                rows.append(row)
        if not rows:
            parser.error(f"{scenes} has none of the scenes that {key} is measured with")
        is_usual = not measurement.needs_scenes or scenes.resolve() == DATA.resolve()
        # Only now: a page never has a part of its table.
        text = rewritten(page.read_text(), key, rows, "" if is_usual else scenes.resolve().name, arguments.sample)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    if measurement.decide is not None:
        print(f"decides for {measurement.decide(rows)}")
    if not arguments.print:
        page.write_text(text)


if __name__ == "__main__":
    main()
