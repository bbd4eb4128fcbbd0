"""The intrinsics that a photograph was read with, and how given ones compare with its matches."""

from dataclasses import dataclass

from .geometry import Camera

_FIELDS = {"FOCAL_LENGTH": "focal_x_px", "PRINCIPAL_X": "principal_x_px", "PRINCIPAL_Y": "principal_y_px", "K1": "k1"}
"""Fields of CameraIntrinsics by the names that rejections give their parameters."""


@dataclass(frozen=True)
class IntrinsicsCheck:
    """Comparison of one intrinsic parameter with the value that the photograph's matches give.

    Attributes:
        parameter: "FOCAL_LENGTH" (along x), "PRINCIPAL_X", "PRINCIPAL_Y" or "K1".
        given: its value in the request; pixels of the photograph, no unit for K1.
        estimated: its value estimated from the photograph alone.
        estimated_sigma: standard deviation of the estimated value.
        given_sigma: standard deviation of the given value.
        conflict: whether they differ by more than both allow; the answer is then a rejection.
        used: whether the pose was computed with the estimated value.
    """

    parameter: str
    given: float
    estimated: float
    estimated_sigma: float
    given_sigma: float
    conflict: bool
    used: bool

    @property
    def differs(self) -> bool:
        """Whether the photograph's value was used, and differs from the given one by more than its usual error."""
        return self.used and abs(self.estimated - self.given) > self.given_sigma

    def __str__(self) -> str:
        name = _FIELDS.get(self.parameter, self.parameter)
        digits = 3 if self.parameter == "K1" else 1
        return (
            f"{name} is {self.given:.{digits}f}, the photograph says {self.estimated:.{digits}f} +- "
            f"{self.estimated_sigma:.{digits}f}{': used' if self.used else ''}"
        )


@dataclass(frozen=True)
class UsedIntrinsics:
    """The intrinsics that a photograph was read with.

    Attributes:
        camera: in pixels of the photograph; where the photograph says better than what was given or chosen, that.
        source: "GIVEN"; "SCENE_CAMERA", of references; "EXIF", the focal length in the photograph's; or "ESTIMATED"
            from its matches.
        focal_sigma_px: standard deviation of the focal length along x.
    """

    camera: Camera
    source: str
    focal_sigma_px: float

    def __str__(self) -> str:
        source = _SOURCES.get(self.source, self.source)
        return f"focal length {self.camera.focal_x_px:.1f} +- {self.focal_sigma_px:.1f} px, {source}"


_SOURCES = {
    "GIVEN": "as given",
    "SCENE_CAMERA": "of the references' camera",
    "EXIF": "by the photograph's EXIF",
    "ESTIMATED": "estimated from the photograph",
}
