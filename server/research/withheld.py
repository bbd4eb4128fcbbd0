"""Photographs of the scenes without their intrinsics, and with them: what is localized, how exactly, how surely.

    python -m research.withheld FOLDER [SCENE...]

Some photographs of each scene are localized against the others by a server of its own, which takes its settings from
the environment: with intrinsics; without; and without a fifth of their columns, so that no reference has the same sides
and the focal length is estimated by the matches alone. A row for each scene, then one for all.
"""

import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from mapless import Client, LocalizationResult, NewReference, Rejected
from mapless.geometry import Camera, RigidTransform
from mapless_tools.child import temporary_server
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.run import await_features

from .places import Scenes, distance_seen, is_right, spread

QUERIES, FRAMES = 3, 14
"""Photographs of each scene that are localized, and that are stored, evenly spread."""
KEPT_COLUMNS = 0.8
APART = ("reichstag-internet", "statue-of-liberty-internet")
"""Their own intrinsics are wrong by some per cent: they do not count among all."""
WAYS = ("given", "withheld", "cut")

Answer = LocalizationResult | Rejected


@dataclass(frozen=True)
class Asked:
    """One photograph's answers, by the way in which it was asked, and the truth."""

    scene: str
    metric: bool
    camera: Camera
    true_pose: RigidTransform
    answers: dict[str, Answer]

    def error(self, way: str) -> tuple[float, float] | None:
        """Errors of the pose, in the scene's unit and in degrees; None for a rejection."""
        answer = self.answers[way]
        return None if isinstance(answer, Rejected) else pose_error(self.true_pose, answer.world_from_camera)

    def is_wrong(self, way: str) -> bool:
        """Whether a pose is off by more than a right one may be, by the distance of its own matches."""
        error, debug = self.error(way), self.answers[way].debug
        if error is None or debug is None:
            return False
        distance = distance_seen(self.camera, self.true_pose, debug.x_in_world[debug.is_inlier])
        return not is_right(*error, distance, self.metric)

    def holds(self, way: str) -> bool:
        """Whether the radius of 95 % contains the error of the position."""
        answer, error = self.answers[way], self.error(way)
        if error is None or isinstance(answer, Rejected) or answer.accuracy is None:
            return False
        return error[0] <= answer.accuracy.position_95_m

    def focal_off(self, way: str) -> float:
        """By how much the focal length of a pose is off, as a share."""
        used = self.answers[way].used_intrinsics
        assert used is not None
        found, true = (it.focal_x_px * it.focal_y_px for it in (used.camera, self.camera))
        return float(abs(np.log(found / true)) / 2)


def asked(client: Client, scenes: Scenes, name: str) -> Iterator[Asked]:
    """Localizes photographs of a scene against the others."""
    dataset = scenes.dataset(name)
    frames, scene = spread(dataset.frames, FRAMES), name.replace("/", "-")
    client.create_scene(scene, arbitrary_unit=not dataset.metric)
    new = [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in frames]
    client.add_references(scene, new)
    await_features(client, scene)
    for frame in spread(frames[1:-1], QUERIES):
        others = [it.name for it in frames if it is not frame]
        image = frame.image_path.read_bytes()

        def localize(image: bytes, camera: Camera | None, others: Sequence[str] = others) -> Answer:
            return client.localize(
                image, camera, scene, others, rerank_references=True, include_debug=True, timeout_s=300
            )

        answers = localize(image, frame.camera), localize(image, None), localize(cut(image), None)
        named = dict(zip(WAYS, answers, strict=True))
        yield Asked(name, dataset.metric, frame.camera, frame.world_from_camera, named)


def cut(image: bytes) -> bytes:
    """The middle of a photograph, without EXIF."""
    file = io.BytesIO()
    with Image.open(io.BytesIO(image)) as opened:
        margin = round(opened.width * (1 - KEPT_COLUMNS) / 2)
        middle = opened.convert("RGB").crop((margin, 0, opened.width - margin, opened.height))
        middle.save(file, "PNG", compress_level=1)
    return file.getvalue()


def row(name: str, found: Sequence[Asked]) -> str:
    """A row of the table: of those localized with intrinsics, those without; errors; radii; wrong ones."""
    known = [it for it in found if it.error("given")]
    cells = [f"{name[:28]:28}", f"{len(known)}/{len(found)}", str(sum(it.is_wrong("given") for it in found))]
    for way in WAYS[1:]:
        both = [it for it in known if it.error(way)]
        new = sum(it.is_wrong(way) and not it.is_wrong("given") for it in found)
        if not both:
            cells.append(f"0 of {len(known)}, {new} newly wrong")
            continue
        ratios = [(it.error(way) or (0, 0))[0] / max((it.error("given") or (0, 0))[0], 1e-9) for it in both]
        cells.append(
            f"{len(both)} of {len(known)}, focal {100 * np.median([it.focal_off(way) for it in both]):.2f} %, "
            f"position x{np.median(ratios):.2f}, radii hold {sum(it.holds(way) for it in both)}, {new} newly wrong"
        )
    return " | ".join(cells)


def main() -> None:
    """Prints the table."""
    folder, *wanted = sys.argv[1:]
    scenes = Scenes(Path(folder))
    names = [it for it in scenes.names if not it.startswith("depth/") and (not wanted or it in wanted)]
    print("scene | with intrinsics | wrong | without | without, cut to other sides")
    everything = list[Asked]()
    with temporary_server() as client:
        for name in names:
            if any(it.image_path.suffix.lower() == ".heic" for it in scenes.dataset(name).frames):
                continue
            found = list(asked(client, scenes, name))
            print(row(name, found), flush=True)
            everything += [it for it in found if name not in APART]
    print(row("all but those apart", everything))


if __name__ == "__main__":
    main()
