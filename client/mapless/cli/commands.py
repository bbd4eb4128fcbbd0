"""All commands except `localize` and `doctor`: each makes a call and prints its answer."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..cameras import read_camera, read_pose
from ..client import Client
from ..geodesy import Datum
from ..geometry import Quaternion, RigidTransform
from ..labels import parse_labels
from ..lenses import lens_model_of
from ..names import check_id
from ..pixels import format_of_image
from ..provenance import ADOPTED, GIVEN, PLACED, Provenance
from ..requests import NewReference
from ..results import PlaceState, Reference, Scene, summary_of
from .adoption import adopted_table, places_table, policy_of, policy_text, retired_table
from .folder import EXIT_FAILED, EXIT_REJECTED
from .localize import depth_of, limits
from .output import card, is_confirmed, plain, serving_states, show, table

_BLANK = "nothing can be matched with it; it is blank, dark or blurred"


def health(client: Client, arguments: argparse.Namespace) -> int:
    """State of the server and of each service: changes can be rejected while queries are answered."""
    serving = serving_states(client, "server")
    states = {name: "SERVING" if it else "NOT_SERVING" for name, it in serving.items()}
    show(arguments, states, card(**states))
    return 0 if serving["server"] else EXIT_FAILED


def create_scene(client: Client, arguments: argparse.Namespace) -> int:
    """Creates a scene."""
    datum, down = _datum(arguments), arguments.down
    is_arbitrary = arguments.unit == "arbitrary"
    scene = client.create_scene(
        arguments.scene,
        datum=datum,
        down_in_world=down,
        arbitrary_unit=is_arbitrary,
        labels=parse_labels(arguments.label),
        adoption=policy_of(arguments, new_unit="arbitrary" if is_arbitrary else ""),
    )
    _warn(scene.warnings)
    return show(arguments, scene, _scene_card(scene))


def update_scene(client: Client, arguments: argparse.Namespace) -> int:
    """Changes properties of a scene."""
    changes: dict[str, Any] = dict.fromkeys(arguments.forget)
    if arguments.datum is not None:
        changes["datum"] = _datum(arguments)
    if arguments.down is not None:
        changes["down_in_world"] = arguments.down
    if arguments.unit is not None:
        changes["arbitrary_unit"] = arguments.unit == "arbitrary"
    if arguments.label:
        changes["labels"] = parse_labels(arguments.label)
    if (policy := policy_of(arguments)) is not None:
        changes["adoption"] = policy
    if both := [it for it in arguments.forget if changes[it] is not None]:
        raise ValueError(f"{both[0]} is given, and to be forgotten")
    if not changes:
        raise ValueError("nothing to change: give --datum, --down, --unit, --label, --adopt or --forget")
    if policy is not None:
        there = client.get_scene(arguments.scene)
        is_arbitrary = changes.get("arbitrary_unit", there.arbitrary_unit)
        is_new = is_arbitrary if there.adoption is None else is_arbitrary != there.arbitrary_unit
        unit = "arbitrary" if is_arbitrary else "the metre"
        changes["adoption"] = policy_of(arguments, there.adoption, unit if is_new else "")
    scene = client.update_scene(arguments.scene, **changes)
    _warn(scene.warnings)
    return show(arguments, scene, _scene_card(scene))


def _warn(warnings: Sequence[str]) -> None:
    for warning in warnings:
        print(f"mapless: warning: {warning}", file=sys.stderr)


def _datum(arguments: argparse.Namespace) -> Datum | None:
    if arguments.datum is None:
        if arguments.enu_from_world is not None:
            raise ValueError("--enu-from-world needs --datum")
        return None
    latitude_deg, longitude_deg, height_m = arguments.datum
    if arguments.enu_from_world is None:
        return Datum(latitude_deg, longitude_deg, height_m)
    return Datum(latitude_deg, longitude_deg, height_m, Quaternion(*arguments.enu_from_world))


def get_scene(client: Client, arguments: argparse.Namespace) -> int:
    """Prints a scene with its datum and calibration."""
    scene = client.get_scene(arguments.scene)
    _warn(scene.warnings)
    return show(arguments, scene, _scene_card(scene))


def _scene_card(scene: Scene) -> list[str]:
    down, calibration = scene.down_in_world, scene.calibration
    counts = {"adopted": scene.adopted_reference_count, "retired": scene.retired_reference_count}
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    return card(
        scene=scene.scene_id,
        references=f"{scene.reference_count}" + (f" ({kinds})" if kinds else ""),
        unit=_unit(scene),
        datum=f"{_place(scene.datum)}, {scene.datum.height_m:.2f} m" if scene.datum else None,
        down=None if down is None else " ".join(f"{it:.4f}" for it in down),
        labels=_labels(scene) or None,
        adopts=policy_text(scene.adoption, "units" if scene.arbitrary_unit else "m"),
        calibration=f"measured with {calibration.query_count} photographs" if calibration else None,
        created=_minute(scene),
        background=f"still makes {summary_of(scene.pending_work)}" if scene.pending_work else None,
    )


def _unit(scene: Scene) -> str:
    return "arbitrary" if scene.arbitrary_unit else "m"


def _labels(scene: Scene) -> str:
    return ", ".join(f"{name}={value}" for name, value in sorted(scene.labels.items()))


def list_scenes(client: Client, arguments: argparse.Namespace) -> int:
    """Lists all scenes, or those with labels."""
    scenes = list(client.list_scenes(labels=parse_labels(arguments.label)))
    rows = [(it.scene_id, it.reference_count, _unit(it), _place(it.datum), _minute(it), _labels(it)) for it in scenes]
    head = "SCENE", "REFERENCES", "UNIT", "LATITUDE, LONGITUDE", "CREATED", "LABELS"
    return show(arguments, scenes, table(head, rows))


def _place(datum: Datum | None) -> str:
    return "" if datum is None else f"{datum.latitude_deg:.5f}, {datum.longitude_deg:.5f}"


def _minute(it: Scene | Reference) -> str:
    return f"{it.create_time:%Y-%m-%d %H:%M}"


def delete_scene(client: Client, arguments: argparse.Namespace) -> int:
    """Deletes a scene and its references; exit code 1 if the user, asked, does not want it."""
    scene = client.get_scene(arguments.scene)
    if not is_confirmed(arguments, f"delete the scene {scene.scene_id} with its {scene.reference_count} references"):
        return EXIT_FAILED
    client.delete_scene(arguments.scene)
    return 0


def add_reference(client: Client, arguments: argparse.Namespace) -> int:
    """Stores a photograph with its camera and pose."""
    reference = NewReference(
        reference_id=arguments.id or _id_of(arguments.photo),
        image=arguments.photo,
        camera=read_camera(arguments.camera, arguments.photo),
        world_from_camera=read_pose(arguments.pose),
        mask=arguments.mask,
        depth=depth_of(arguments),
    )
    stored = client.add_reference(arguments.scene, reference)
    if not stored.feature_count:
        print(f"mapless: warning: {arguments.photo} is stored, but has no local features: {_BLANK}", file=sys.stderr)
    _warn(stored.warnings)
    if stored.depth_sha256:
        stored = replace(stored, depth=reference.depth)
    return show(arguments, stored, _reference_card(stored))


def _id_of(photo: Path) -> str:
    """Returns the reference id for a photograph's file name."""
    try:
        return check_id(photo.stem)
    except ValueError as error:
        raise ValueError(f"{photo}: its name gives no id, so give one with --id: {error}") from None


def list_references(client: Client, arguments: argparse.Namespace) -> int:
    """Lists the references of a scene."""
    if client.get_scene(arguments.scene).arbitrary_unit:
        print("mapless: note: the scene's unit of length is arbitrary, not the metre", file=sys.stderr)
    wanted = {"only_adopted": arguments.adopted, "only_retired": arguments.retired}
    references = list(client.list_references(arguments.scene, **wanted))
    if arguments.places:
        seen = [it for it in references if it.place is not None and it.provenance.source != ADOPTED]
        return show(arguments, seen, places_table(seen))
    if arguments.adopted or arguments.retired:
        text = adopted_table(references) if arguments.adopted else retired_table(references)
        return show(arguments, references, text)
    rows = [
        (it.reference_id, _size(it), *_position(it.world_from_camera), it.feature_count, _minute(it))
        for it in references
    ]
    head = ("REFERENCE", "SIZE", "X", "Y", "Z", "FEATURES", "CREATED")
    return show(arguments, references, table(head, rows))


def _size(it: Reference) -> str:
    return f"{it.camera.width_px}x{it.camera.height_px}"


def _position(pose: RigidTransform) -> list[str]:
    return [f"{coordinate:.3f}" for coordinate in pose.translation]


def _reference_card(it: Reference, unit: str = "m") -> list[str]:
    camera, q = it.camera, it.world_from_camera.quaternion()
    lens = None if camera.distortion is None else lens_model_of(camera.distortion)
    return card(
        reference=it.reference_id,
        size=_size(it),
        focal=f"{camera.focal_x_px:.2f} {camera.focal_y_px:.2f} px",
        principal=f"{camera.principal_x_px:.2f} {camera.principal_y_px:.2f} px",
        lens=None if lens is None else f"{lens} {' '.join(f'{k:g}' for k in vars(camera.distortion).values())}",
        position=" ".join(_position(it.world_from_camera)),
        rotation=f"x {q.x:.4f}  y {q.y:.4f}  z {q.z:.4f}  w {q.w:.4f}",
        pose=_pose_of(it.provenance, unit),
        surveyed=f"{100 * it.provenance.surveyed_share:.0f} % of its matches" if it.provenance.vouchers else None,
        vouchers=", ".join(f"{one.reference_id} {one.match_count}" for one in it.provenance.vouchers) or None,
        place=_place_of(it),
        retired=it.retirement.removeprefix("retired on ") or None,
        depth=_depth_of(it),
        features=it.feature_count,
        sha256=it.image_sha256,
        created=_minute(it),
    )


def _depth_of(it: Reference) -> str | None:
    if it.depth is None:
        return None
    depth = plain(it.depth)
    parts = ["x".join(map(str, depth["size"])), f"unit {it.depth.unit_m:g} m", f"sensor {it.depth.sensor.value}"]
    parts += ["its own noise"] * (it.depth.noise is not None) + ["confidence"] * bool(it.depth.confidence)
    parts += ["another camera"] * (it.depth.camera is not None or it.depth.camera_from_depth_camera is not None)
    return ", ".join(parts)


def _pose_of(provenance: Provenance, unit: str) -> str:
    accuracy = provenance.accuracy
    known = {PLACED: "placed by mapless", GIVEN: "given", ADOPTED: "adopted from a localized photograph"}
    source = known.get(provenance.source, "unknown")
    return source if accuracy is None else f"{source}, within {accuracy.position_95_m:.3g} {unit} (95 %)"


def _place_of(it: Reference) -> str | None:
    known = [f"of {it.place_reference}"] * bool(it.place_reference)
    return ": ".join(known + ([] if it.place is None else [_state_of(it.place)])) or None


def _state_of(place: PlaceState) -> str:
    count = place.photograph_count
    left = f"{100 * place.surveyed_share:.0f} % of the survey left, by {count} photograph{'' if count == 1 else 's'}"
    outdated = ", so it needs a new survey" if place.is_outdated else ""
    return f"{left}{outdated}; {place.contradiction_count} contradictions in a row"


def show_reference(client: Client, arguments: argparse.Namespace) -> int:
    """Prints a reference without its photograph; what is known of a depth comes with its bytes alone."""
    found = client.get_reference(arguments.scene, arguments.reference)
    if found.depth_sha256:
        whole = client.get_reference(arguments.scene, arguments.reference, include_image=True)
        found = replace(whole, image=None, mask=None)
    has_radius = found.provenance.accuracy is not None
    unit = "units" if has_radius and client.get_scene(arguments.scene).arbitrary_unit else "m"
    return show(arguments, found, _reference_card(found, unit))


def download_reference(client: Client, arguments: argparse.Namespace) -> int:
    """Writes the photograph of a reference to a file."""
    found = client.get_reference(arguments.scene, arguments.reference, include_image=True)
    image = found.image or b""
    if str(arguments.output) == "-":
        sys.stdout.buffer.write(image)
        return 0
    ending = format_of_image(image).replace("jpeg", "jpg")
    file = arguments.output or Path(found.reference_id + (ending and f".{ending}"))
    try:
        with file.open("wb" if arguments.force else "xb") as target:
            target.write(image)
    except FileExistsError:
        raise ValueError(f"{file} exists; --force overwrites it") from None
    return show(arguments, {"file": str(file)}, [str(file)])


def delete_reference(client: Client, arguments: argparse.Namespace) -> int:
    """Deletes a reference; exit code 1 if the user, asked, does not want it."""
    if not is_confirmed(arguments, f"delete the reference {arguments.reference} of {arguments.scene}"):
        return EXIT_FAILED
    client.delete_reference(arguments.scene, arguments.reference)
    return 0


def retrieve(client: Client, arguments: argparse.Namespace) -> int:
    """Finds the references most similar to a photograph."""
    camera = read_camera(arguments.camera, arguments.photo)
    found = client.retrieve_references(
        arguments.photo,
        camera,
        arguments.scene,
        count=arguments.count,
        priors=limits(arguments),
        mask=arguments.mask,
    )
    rows = [(it.name.rpartition("/")[2], f"{it.similarity:.3f}", *_position(it.world_from_camera)) for it in found]
    return show(arguments, found, table(("REFERENCE", "SIMILARITY", "X", "Y", "Z"), rows))


def coverage(client: Client, arguments: argparse.Namespace) -> int:
    """Predicts whether a photograph at a pose would be localized."""
    pose, camera = read_pose(arguments.pose), read_camera(arguments.camera)
    found = client.check_coverage(arguments.scene, pose, camera)
    unit = "units" if found.arbitrary_unit else "m"
    radius = None if found.position_68_m is None else f"within {found.position_68_m:.3g} {unit} (68 %)"
    text = card(
        verdict=found.verdict,
        position=radius,
        matches=f"{found.expected_match_count} expected, in {100 * found.image_share:.0f} % of the image",
        references=len(found.references),
    )
    show(arguments, found, [*text, found.message])
    return EXIT_REJECTED if found.verdict == "NOT_LOCALIZABLE" else 0
