"""`cameras.json` and images: our own layout, described in `dataset`.

`dataset.read_folder` gives up at the first frame that is wrong, as is right for what we wrote ourselves; here the
others are kept.
"""

from __future__ import annotations

from pathlib import Path

from mapless_tools.dataset import FILE_NAME, Dataset, Frame, Refusal, dataset_of, frame_label, read_content, read_frame

from .options import ReadOptions


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / FILE_NAME).is_file()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads it; see `read_dataset`."""
    content = read_content(path)
    frames: list[Frame] = []
    refused: list[Refusal] = []
    ids: set[str] = set()
    images: set[Path] = set()
    for index, entry in enumerate(content["frames"]):
        try:
            frame = read_frame(path, entry, ids)
            if frame.image_path in images:
                raise ValueError(f"image: {entry['image']!r} is named twice")
        except ValueError as error:
            refused.append(Refusal(f"{FILE_NAME}: {frame_label(index, entry)}", str(error)))
            continue
        ids.add(frame.name)
        images.add(frame.image_path)
        frames.append(frame)
    if not frames:
        first = refused[0]
        raise ValueError(f"{path}: none of {len(refused)} frames can be used; {first.frame}: {first.reason}")
    return dataset_of(path, content, frames, refused)
