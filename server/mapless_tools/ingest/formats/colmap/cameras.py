"""COLMAP's camera models, and which of them mapless has."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

from mapless.geometry import Camera
from mapless.lenses import Distortion, Fisheye, RadialTangential, unknown_lens

from ..collecting import from_corner

PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", *(f"d{i}" for i in range(12))),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),
}
"""Parameters of each model; the order of models is that of their numbers in binary files."""

MODEL_NAMES = tuple(PARAMETERS)

_FISHEYE = frozenset({"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"})
_PERSPECTIVE = frozenset({"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"})


@dataclass(frozen=True)
class ColmapCamera:
    """A camera in a model's form, of COLMAP or of a layout that uses its cameras; mapless may not have the model."""

    camera_id: int | str
    model: str
    width_px: int
    height_px: int
    parameters: Sequence[float]

    def camera(self) -> Camera:
        """Converts it to a mapless camera; ValueError if there is no such model."""
        if self.model not in _FISHEYE | _PERSPECTIVE:
            raise ValueError(
                f"camera {self.camera_id}: its model {self.model} has no counterpart here; undistort the images first "
                "(colmap image_undistorter), or use OPENCV or OPENCV_FISHEYE"
            )
        value = dict(zip(PARAMETERS[self.model], self.parameters, strict=True))
        rational = {name: value[name] for name in ("k4", "k5", "k6") if name in value and self.model == "FULL_OPENCV"}
        if any(rational.values()):
            raise ValueError(
                f"camera {self.camera_id}: the denominator of FULL_OPENCV's distortion ("
                + ", ".join(f"{name} = {number:g}" for name, number in rational.items())
                + ") has no counterpart here; undistort the images first, or use OPENCV"
            )
        focal = value.get("f", 0.0)
        k = (value.get("fx", focal), value.get("fy", focal), value["cx"], value["cy"])
        return from_corner(Camera(self.width_px, self.height_px, *k, _distortion(self.model, value)))


def _distortion(model: str, value: dict[str, float]) -> Distortion | None:
    if model in _FISHEYE:
        return Fisheye(*(value.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")))
    lens = RadialTangential(*(value.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")))
    return None if lens == RadialTangential() else lens


def from_camera(camera_id: int | str, camera: Camera) -> ColmapCamera:
    """Converts a mapless camera to COLMAP's form."""
    lens = camera.distortion
    model = "PINHOLE"
    coefficients: tuple[float, ...] = ()
    if isinstance(lens, Fisheye):
        model, coefficients = "OPENCV_FISHEYE", astuple(lens)
    elif isinstance(lens, RadialTangential) and lens.k3 == 0:
        model, coefficients = "OPENCV", (lens.k1, lens.k2, lens.p1, lens.p2)
    elif isinstance(lens, RadialTangential):
        model, coefficients = "FULL_OPENCV", (*astuple(lens), 0.0, 0.0, 0.0)
    elif lens is not None:
        raise unknown_lens(lens)
    centre = (camera.principal_x_px + 0.5, camera.principal_y_px + 0.5)
    parameters = (camera.focal_x_px, camera.focal_y_px, *centre, *coefficients)
    return ColmapCamera(camera_id, model, camera.width_px, camera.height_px, parameters)
