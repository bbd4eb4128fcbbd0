"""Writes the demo's photographs: `PYTHONPATH=client:server python -m research.rendered_room FOLDER`, some minutes."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from .folders import entry_of, write_cameras, write_photograph
from .furniture import lit_room
from .photographs import cast, scatter, visible_edges, walk

DEPTH_PX = (240, 180)


def main(folder: Path) -> None:
    """Write photographs, depths, cameras and outline of the demo's room."""
    room = lit_room(0)
    references, queries = walk(0, 16), scatter(0, 8, room)
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    for station in references + queries:
        write_photograph(folder / "images", room, station)
        depth_mm = 1000 / cast(room, station.camera.resized(*DEPTH_PX), station.world_from_camera)[0]
        best = [cv2.IMWRITE_PNG_COMPRESSION, 9]
        cv2.imwrite(str(folder / "depth" / f"{station.name}.png"), np.rint(depth_mm).astype(np.uint16), best)
    write_cameras(folder, [entry_of(it) for it in references + queries])
    visible = {it.name: np.round(visible_edges(room, it), 4).tolist() for it in queries}
    outline = {"edges": np.round(room.outline, 4).tolist(), "visible_edges": visible}
    (folder / "outline.json").write_text(json.dumps(outline, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
