"""Writes the demo's photographs: `PYTHONPATH=client:server python -m research.rendered_room FOLDER`, some minutes."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from .furniture import lit_room
from .photographs import cast, photograph, scatter, visible_edges, walk

DEPTH_PX = (240, 180)


def main(folder: Path) -> None:
    """Write photographs, depths, cameras and outline of the demo's room."""
    room = lit_room(0)
    references, queries = walk(0, 16), scatter(0, 8, room)
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = []
    for station in references + queries:
        camera, pose = station.camera, station.world_from_camera
        image = cv2.cvtColor(photograph(room, station, 0), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "images" / f"{station.name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 92])
        depth_mm = 1000 / cast(room, camera.resized(*DEPTH_PX), pose)[0]
        best = [cv2.IMWRITE_PNG_COMPRESSION, 9]
        cv2.imwrite(str(folder / "depth" / f"{station.name}.png"), np.rint(depth_mm).astype(np.uint16), best)
        size = {"width": camera.width_px, "height": camera.height_px, "K": camera.matrix().tolist()}
        matrix = pose.matrix().tolist()
        frames.append({"image": f"images/{station.name}.jpg", **size, "dist": None, "world_from_camera": matrix})
    about = {"source": "rendered by server/research/rendered_room", "license": "Apache-2.0", "metric": True}
    one_a_line = ",\n".join(f"  {json.dumps(it)}" for it in frames)
    head = json.dumps({**about, "frames": []}, indent=1)
    (folder / "cameras.json").write_text(head.replace("[]", f"[\n{one_a_line}\n ]") + "\n")
    visible = {it.name: np.round(visible_edges(room, it), 4).tolist() for it in queries}
    outline = {"edges": np.round(room.outline, 4).tolist(), "visible_edges": visible}
    (folder / "outline.json").write_text(json.dumps(outline, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
