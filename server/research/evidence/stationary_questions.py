"""Questions about what is fixed to the camera, see `stationary`."""

from .page import Question

DATA = (
    "The drive of KITTI (980 pixels wide, 13 references), the kitchen of 7-Scenes (512 pixels, 14 references) and the "
    "demo's room (480 pixels, 16 references), at most 1024 keypoints, ten references of each photograph, with the "
    "overlays of `research.evidence.overlays` on every photograph (badge, bonnet, gripper, time stamp whose digits "
    "change, display, half-transparent watermark); asked with 6 photographs of other places (office, meeting room, "
    "fountain, kitchen, room; the drive also with its own mirrored ones) that carry the same overlay, 2 of them with "
    "nothing ignored too, and with 4 of the place itself. A right one is within 0.25 m. EdgePoint2 is measured where "
    "`MAPLESS_WEIGHTS_DIR` has its weights, with nearest neighbours."
)
_DRIVE = (
    "The drive of KITTI as it is, 26 photographs ahead, SIFT: the share of keypoints that are ignored in ten "
    "references that follow one another, by all matches of their descriptors."
)
_CODE = "mapless_server.method.pairs.stationary:StationaryOptions"
_FAR = (
    "SIFT on the drive with a display and with a watermark, as in [stationary-overlays](stationary-overlays.md): 12 "
    "photographs of other places, 8 of the place itself."
)
_SAME = (
    "References of the drive, the kitchen and the room, every fourth, each beside itself made darker or brighter, "
    "blurred and with noise (three ways); and the first reference with each overlay beside three photographs of other "
    "places with it. SIFT, matches within four pixels of 1024 columns."
)
QUESTIONS = {
    it.key: it
    for it in (
        Question(
            "stationary-overlays",
            f"{_CODE}.reach",
            "How many photographs of other places are localized because they carry the same picture as the references, "
            "and how many of the place itself are lost by ignoring it?",
            DATA + " Beside it the same with the pixels of the overlay black, and their keypoints removed.",
            "Two cells to each side, 2.5 of 160 columns: digits that change are as far from those that do not. "
            "Measured at c8d04a62: 1 of 216 photographs of other places is localized, 144 of 144 of the place itself, "
            "as with the pixels black. The one is the drive's own first photograph, mirrored, that EdgePoint2 matches "
            "rightly with 253 keypoints of the same houses; with the badge black and masked it is localized too, so "
            "it is not the badge. Before matches at the same pixels were no evidence (see stationary-unmoved-px), a "
            "display and a watermark on the drive localized 3 of 12 by SIFT: the drive turns by 0.03 degrees a "
            "metre, so that a point 700 m away is at the same pixels, to a few, in all its photographs, and what is "
            "fixed on that side of the image is explained so.",
        ),
        Question(
            "stationary-contradicted-px",
            f"{_CODE}.contradicted_px",
            "How far must the pixels of a match be from all that the poses explain, so that it is of no place?",
            _DRIVE,
            "Four pixels of an image of 1024 columns: the drive has nothing fixed to its camera, so all that is "
            "ignored is wrong, and at most 1 % may be. Its turns are a tenth of a degree between photographs; with "
            "greater bounds more of a bonnet on a straight drive is explained as far away.",
        ),
        Question(
            "stationary-support",
            f"{_CODE}.support",
            "How many matches at the same pixels show that a part of the image is fixed to the camera?",
            _DRIVE,
            "Three: single wrong matches are at the same pixels by chance, and more would leave small texts.",
        ),
        Question(
            "stationary-unmoved-px",
            f"{_CODE}.unmoved_px",
            "How far from the same pixels are matches that are no evidence? With 0 all are evidence.",
            _FAR,
            "Four pixels of 1024 columns: strokes of half-transparent letters are found to three.",
        ),
        Question(
            "stationary-same-view-share",
            f"{_CODE}.same_view_share",
            "In which share of an image's parts must two photographs match at the same pixels, so that both show the "
            "same from the same place?",
            _SAME,
            "Two fifths: a display or a watermark, spread over the image, is in a third at most.",
        ),
    )
}
