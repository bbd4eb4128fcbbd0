"""Masks of a dataset's photographs: a folder under COLMAP's names, or one file for all."""

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path, PurePath

from mapless.masks import find_mask, mask_name
from mapless_tools.dataset import Dataset, Frame


def with_masks(dataset: Dataset, root: Path, masks: Path) -> Dataset:
    """Gives each photograph its mask, in place of one that the layout names; a note counts them.

    The name of a mask is found from the path that the photograph has in its folder of images, which is one of the
    folders from `root` on, or the last of them alone where it is unique.

    ValueError if no photograph has a mask there.
    """
    names = Counter(frame.image_path.name for frame in dataset.frames)
    found = [find_mask(masks, _names(frame, root, names[frame.image_path.name] == 1)) for frame in dataset.frames]
    count = sum(it is not None for it in found)
    if not count:
        expected = mask_name(dataset.frames[0].image_path.name)
        raise ValueError(f"{masks} has a mask of none of the photographs: {expected} in it would be the first's")
    frames = (
        replace(frame, mask_path=mask or frame.mask_path) for frame, mask in zip(dataset.frames, found, strict=True)
    )
    note = f"masks: {count} of {len(dataset.frames)} photographs have one in {masks}"
    return replace(dataset, frames=tuple(frames), notes=(*dataset.notes, note))


def with_own_masks(dataset: Dataset, images: Path, masks: Path) -> Dataset:
    """`with_masks` if the layout's folder of masks has any under COLMAP's names; others may have another purpose."""
    names = (frame.image_path.relative_to(images).as_posix() for frame in dataset.frames)
    are_there = any(os.path.isfile(masks / mask_name(name)) for name in names)
    return with_masks(dataset, images, masks) if are_there else dataset


def _names(frame: Frame, root: Path, is_unique: bool) -> list[str]:
    """Paths that the photograph may have in its folder of images, the longest first."""
    image = frame.image_path
    inside: PurePath = image.relative_to(root) if image.is_relative_to(root) else PurePath(image.name)
    parts = inside.parts
    paths = ["/".join(parts[i:]) for i in range(len(parts) - 1)]
    return [*paths, image.name] if is_unique or len(parts) == 1 else paths
