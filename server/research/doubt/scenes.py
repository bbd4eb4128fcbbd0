"""The folders that are measured, and which of them show one place."""

from research.contradictions.places import BOX, CAN, CHESS, FOUNTAIN, KITCHEN, LOCKERS, MEETING, STATUE

PLACES: tuple[tuple[str, ...], ...] = (
    (KITCHEN, "depth/kinect-kitchen"),
    ("tum-fr3-office", "depth/tum-teddy"),
    (BOX,),
    (CAN,),
    (CHESS,),
    ("depth/lidar-desk",),
    ("depth/realsense-robot",),
    ("euroc-v101-drone",),
    (FOUNTAIN,),
    ("fox-portrait",),
    ("herz-jesus-P8",),
    ("kitti-drive-a",),
    (MEETING,),
    (LOCKERS,),
    ("phone-on-desk",),
    ("reichstag-internet",),
    (STATUE,),
    ("studio-flat",),
    ("video/phone-tag-exif",),
    ("video/phone-desk-exif",),
)
"""Folders, those of one place together: the second place's two were recorded in one hall."""
FOLDERS = tuple(folder for folders in PLACES for folder in folders)


def crossed(count: int) -> list[tuple[str, str]]:
    """So many ordered pairs of folders of different places, in steps of equal length over all pairs.

    With more than there are, all come again.
    """
    pairs = [(of, at) for one in PLACES for other in PLACES if one is not other for of in one for at in other]
    rounds, rest = divmod(count, len(pairs))
    return pairs * rounds + [pairs[i * len(pairs) // rest] for i in range(rest)]
