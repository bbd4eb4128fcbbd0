"""A scene as one binary glTF file: cameras as frusta with small photographs, and points: shared ones, and of depth.

Any viewer can show it. The root node rotates the scene's world to glTF's axes (y up); below it, positions are relative
to the middle of the scene, so that single precision is enough. Each reference is a node with glTF's axes of cameras (x
right, y up, z back); `extras` have the reference's id, camera and pose, and the scene's datum, down and unit. Points
are nodes beside: `points` are triangulated, `points by depth` matched with a depth, and `depth of ID` is the depth that
a reference came with, thinned. The latter two have a bluish material, and viewers can hide nodes.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pygltflib as gl
from numpy.typing import NDArray

from mapless import Client, LocalizationResult, MaplessError, Reference
from mapless import Scene as KnownScene
from mapless.geometry import Array, Quaternion, RigidTransform
from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, decode_image
from mapless_tools.depth_points import ColouredPoints, depth_points, share_of
from mapless_tools.matches import colours_at
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress
from mapless_tools.view.scenery import Scenery, lay_out

from .fetching import Export, fetch_all
from .formats.collecting import OPENCV_FROM_OPENGL

PICTURES, THUMBNAIL_PX = 200, 128
"""Photographs in the file, and the longer side of each: some kilobytes, so that a page can load the file."""
POINT_SOURCES = 40
"""References that are localized among the others for the points that they share; each takes as long as a query."""
_LINE_COLOUR = [0.2, 0.5, 1.0, 1.0]
_DEPTH_COLOUR = [0.55, 0.8, 1.0, 1.0]
"""By which the colours of points by depth are multiplied."""
_POINTS, _DEPTH = 1, 2
"""Materials of points."""
_GAMMA = 2.2
"""Gamma of photographs; colours of points are linear in glTF."""
_UNLIT = "KHR_materials_unlit"


@dataclass(frozen=True, eq=False)
class View:
    """A reference as it is drawn.

    Attributes:
        reference: its camera and pose.
        thumbnail: its small photograph, JPEG.
        points: triangulated points that it shows.
        by_depth: points that it matches, whose distance a depth gives.
        depth: its own depth.
    """

    reference: Reference
    thumbnail: bytes | None = None
    points: ColouredPoints | None = None
    by_depth: ColouredPoints | None = None
    depth: ColouredPoints | None = None


def export_gltf(client: Client, scene: str, folder: Path, progress: Progress) -> Export:
    """Writes SCENE.glb into a folder; see `export_scene`."""
    known = client.get_scene(scene)
    left = iter(range(POINT_SOURCES))
    share = share_of(min(known.reference_count, PICTURES))

    def take(reference: Reference) -> View:
        if reference.image is None:
            return View(reference)
        try:
            image = decode_image(reference.image, ANY_SIZE)
        except InvalidArgument:
            return View(reference)
        points = _points(client, scene, reference, image) if next(left, None) is not None else (None, None)
        small = thumbnail(np.ascontiguousarray(image[..., ::-1]))
        return View(reference, small, *points, depth_points(reference, image, share, not known.arbitrary_unit))

    views, damaged = fetch_all(client, scene, take, progress, PICTURES)
    if views:
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(folder / f"{scene}.glb") as file:
            file.write_bytes(to_gltf(known, views))
    return Export(len(views), damaged)


def thumbnail(image: NDArray[np.uint8]) -> bytes:
    """A small photograph (JPEG) of one (H, W, 3) BGR."""
    scale = THUMBNAIL_PX / max(image.shape[:2])
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return bytes(cv2.imencode(".jpg", cv2.resize(image, size, interpolation=cv2.INTER_AREA))[1])


def _points(
    client: Client, scene: str, reference: Reference, image: NDArray[np.uint8]
) -> tuple[ColouredPoints | None, ColouredPoints | None]:
    """Points that a photograph (H, W, 3) RGB shares with others, triangulated and by depth; None after a failure."""
    try:
        answer = client.localize(reference.image or b"", reference.camera, scene, include_debug=True)
    except MaplessError:
        return None, None
    if not isinstance(answer, LocalizationResult) or answer.debug is None:
        return None, None
    debug = answer.debug
    colours = colours_at(image, reference.camera, debug.query_px)
    kinds = debug.is_inlier & ~debug.is_by_depth, debug.is_inlier & debug.is_by_depth
    triangulated, by_depth = (ColouredPoints(debug.x_in_world[it], colours[it]) for it in kinds)
    return triangulated, by_depth


def to_gltf(scene: KnownScene, views: Sequence[View]) -> bytes:
    """The file's content."""
    scenery = lay_out(scene, [it.reference for it in views], PICTURES)
    file = _File(scene, scenery)
    for view in views:
        file.add_camera(view)
    file.add_points("points", [it.points for it in views], _POINTS)
    file.add_points("points by depth", [it.by_depth for it in views], _DEPTH)
    for view in views:
        file.add_points(f"depth of {view.reference.reference_id}", [view.depth], _DEPTH)
    return file.content()


class _File:
    """A glTF file that is being built; offsets are filled in at its end."""

    def __init__(self, scene: KnownScene, scenery: Scenery) -> None:
        self._scenery = scenery
        self._blob = bytearray()
        self._frustums: dict[Any, tuple[int, int]] = {}
        self._in_world: list[int] = []
        datum = scene.datum.to_json() if scene.datum else None
        about = {"scene": scene.scene_id, "arbitrary_unit": scene.arbitrary_unit, "datum": datum}
        about |= {"down_in_world": scene.down_in_world, "origin_in_world": scenery.origin.tolist()}
        self._gltf = gl.GLTF2(
            asset=gl.Asset(version="2.0", generator="mapless-server export"),
            scene=0,
            scenes=[gl.Scene(name=scene.scene_id, nodes=[0])],
            nodes=[
                gl.Node(name=scene.scene_id, rotation=_upright(scenery.down), children=self._in_world, extras=about)
            ],
            materials=[
                _material("lines", baseColorFactor=_LINE_COLOUR),
                _material("points", baseColorFactor=[1.0, 1.0, 1.0, 1.0]),
                _material("points by depth", baseColorFactor=_DEPTH_COLOUR),
            ],
            extensionsUsed=[_UNLIT],
        )

    def add_camera(self, view: View) -> None:
        """Adds a node with a camera, its frustum, and its photograph if there is one."""
        reference = view.reference
        pose = self._scenery.placed(reference.world_from_camera)
        turned = RigidTransform(pose.rotation @ OPENCV_FROM_OPENGL, pose.translation)
        q = turned.quaternion()
        camera, mesh = self._frustum(reference)
        # A node of its own, without children: some readers end at a camera.
        children = [self._node(gl.Node(name=f"camera of {reference.reference_id}", camera=camera))]
        if view.thumbnail is not None:
            picture = self._picture(reference, view.thumbnail)
            children.append(self._node(gl.Node(name=f"photograph of {reference.reference_id}", mesh=picture)))
        intrinsics = {name: value for name, value in asdict(reference.camera).items() if value is not None}
        about = {"reference": reference.reference_id, "camera": intrinsics}
        about |= {"world_from_camera": reference.world_from_camera.matrix().tolist()}
        node = gl.Node(
            name=reference.reference_id,
            translation=turned.translation.tolist(),
            rotation=[q.x, q.y, q.z, q.w],
            mesh=mesh,
            children=children,
            extras=about,
        )
        self._in_world.append(self._node(node))

    def add_points(self, name: str, given: Sequence[ColouredPoints | None], material: int) -> None:
        """Adds a node with all these points, if there are any."""
        some = [it for it in given if it is not None and len(it.points)]
        if not some:
            return
        points, colours = (np.concatenate([getattr(it, part) for it in some]) for part in ("points", "colours"))
        positions = self._array((points - self._scenery.origin).astype(np.float32), gl.FLOAT, "VEC3")
        linear = np.rint(255 * (colours / 255) ** _GAMMA).astype(np.uint8)
        rgba = np.concatenate([linear, np.full((len(colours), 1), 255, np.uint8)], axis=1)  # four bytes: aligned
        colour = self._array(rgba, gl.UNSIGNED_BYTE, "VEC4", normalized=True)
        mesh = self._mesh(name, gl.Attributes(POSITION=positions, COLOR_0=colour), gl.POINTS, material)
        self._in_world.append(self._node(gl.Node(name=name, mesh=mesh)))

    def content(self) -> bytes:
        self._gltf.buffers = [gl.Buffer(byteLength=len(self._blob))]
        self._gltf.set_binary_blob(bytes(self._blob))
        return b"".join(self._gltf.save_to_bytes())

    def _frustum(self, reference: Reference) -> tuple[int, int]:
        """The camera and the mesh of lines for a reference's intrinsics, which many references share."""
        camera = reference.camera
        if camera not in self._frustums:
            perspective = gl.Perspective(
                yfov=float(2 * np.arctan(camera.height_px / 2 / camera.focal_y_px)),
                aspectRatio=camera.width_px / camera.focal_x_px * camera.focal_y_px / camera.height_px,
                znear=self._scenery.size_m / 100,
            )
            self._gltf.cameras.append(gl.Camera(type="perspective", perspective=perspective))
            corners = self._corners(reference)
            apex = np.zeros(3)
            ends = [(apex, it) for it in corners] + [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
            lines = self._array(np.array(ends, np.float32).reshape(-1, 3), gl.FLOAT, "VEC3")
            mesh = self._mesh("frustum", gl.Attributes(POSITION=lines), gl.LINES, material=0)
            self._frustums[camera] = len(self._gltf.cameras) - 1, mesh
        return self._frustums[camera]

    def _corners(self, reference: Reference) -> Array:
        """Corners (4, 3) of the photograph at the frustum's end, in glTF's axes, clockwise from the top left."""
        camera = reference.camera.pinhole()
        right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
        rays = camera.rays(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))
        return rays / rays[:, 2:] * self._scenery.size_m @ OPENCV_FROM_OPENGL

    def _picture(self, reference: Reference, thumbnail: bytes) -> int:
        gltf = self._gltf
        gltf.images.append(gl.Image(bufferView=self._view(thumbnail), mimeType="image/jpeg"))
        gltf.textures.append(gl.Texture(source=len(gltf.images) - 1))
        gltf.materials.append(_material("photograph", baseColorTexture=gl.TextureInfo(index=len(gltf.textures) - 1)))
        around = [0, 3, 2, 0, 2, 1]  # counterclockwise where the camera stands
        positions = self._array(self._corners(reference)[around].astype(np.float32), gl.FLOAT, "VEC3")
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[around]
        attributes = gl.Attributes(POSITION=positions, TEXCOORD_0=self._array(uv, gl.FLOAT, "VEC2"))
        return self._mesh("photograph", attributes, gl.TRIANGLES, material=len(gltf.materials) - 1)

    def _node(self, node: gl.Node) -> int:
        self._gltf.nodes.append(node)
        return len(self._gltf.nodes) - 1

    def _mesh(self, name: str, attributes: gl.Attributes, mode: int, material: int) -> int:
        self._gltf.meshes.append(
            gl.Mesh(name=name, primitives=[gl.Primitive(attributes=attributes, mode=mode, material=material)])
        )
        return len(self._gltf.meshes) - 1

    def _array(self, values: NDArray[Any], component: int, kind: str, normalized: bool = False) -> int:
        accessor = gl.Accessor(
            bufferView=self._view(values.tobytes(), gl.ARRAY_BUFFER),
            componentType=component,
            count=len(values),
            type=kind,
            normalized=normalized,
            min=values.min(axis=0).tolist(),
            max=values.max(axis=0).tolist(),
        )
        self._gltf.accessors.append(accessor)
        return len(self._gltf.accessors) - 1

    def _view(self, data: bytes, target: int | None = None) -> int:
        self._gltf.bufferViews.append(
            gl.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(data), target=target)
        )
        self._blob += data + bytes(-len(data) % 4)
        return len(self._gltf.bufferViews) - 1


def _upright(down: Array) -> list[float]:
    """Quaternion x, y, z, w of the rotation from the world to glTF's axes, in which y points up."""
    up = -np.asarray(down, float)
    side = np.eye(3)[np.argmin(np.abs(up))]
    back = np.cross(side, up)
    back /= np.linalg.norm(back)
    q = Quaternion.from_matrix(np.stack([np.cross(up, back), up, back]))
    return [q.x, q.y, q.z, q.w]


def _material(name: str, **colour: Any) -> gl.Material:
    """A material that is visible without lights, from both sides."""
    metallic = gl.PbrMetallicRoughness(metallicFactor=0.0, **colour)
    return gl.Material(
        name=name, pbrMetallicRoughness=metallic, doubleSided=True, extensions={_UNLIT: {}}, alphaCutoff=None
    )
