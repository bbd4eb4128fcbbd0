"""Names of scenes and references: "scenes/{scene}" and "scenes/{scene}/references/{reference}"."""

import re
from collections.abc import Sequence

_ID = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,126}[A-Za-z0-9_])?", re.ASCII)
_SHOWN_CHARACTERS = 60  # of a wrong value in an error message: ids of 10,000 have been sent


def check_id(value: str) -> str:
    """The id of a scene or a reference, unchanged; ValueError if the value is not an id."""
    if not value:
        raise ValueError("an id is 1 to 128 characters; got an empty one")
    if not _ID.fullmatch(value) or ".." in value:
        raise ValueError(
            "an id is 1 to 128 characters of A-Z a-z 0-9 . _ -, begins and ends with a letter, digit or underscore and "
            f"does not contain '..'; got {shown(value)}"
        )
    return value


def scene_name(scene: str) -> str:
    """The name of a scene given by id or by name; TypeError for another type than text, ValueError for an empty one."""
    if not isinstance(scene, str):
        raise TypeError(f"scene must be its id or name, is {scene!r}")
    if not scene:
        raise ValueError("scene must be its id or name, is empty")
    return scene if scene.startswith("scenes/") else f"scenes/{scene}"


def reference_name(scene: str, reference: str) -> str:
    """The name of a reference given by id or by name, in a scene given by id or by name."""
    return reference if reference.startswith("scenes/") else f"{scene_name(scene)}/references/{reference}"


def reference_names(scene: str, references: Sequence[str]) -> list[str]:
    """The names of references, as `reference_name`; TypeError for a single one, which is a sequence of letters."""
    if isinstance(references, str):
        raise TypeError(f"references must be a list of ids or names, is the text {shown(references)}")
    for i, reference in enumerate(references):
        if not isinstance(reference, str):
            raise TypeError(f"references[{i}] must be an id or a name, is {shown(repr(reference))}")
    return [reference_name(scene, reference) for reference in references]


def parse_scene_name(name: str) -> str:
    """The scene's id; ValueError if the name is not "scenes/{scene}"."""
    collection, _, scene_id = name.partition("/")
    if collection != "scenes" or not scene_id:
        raise ValueError(f"must be scenes/{{scene}}, got {shown(name)}")
    return check_id(scene_id)


def parse_reference_name(name: str) -> tuple[str, str]:
    """The ids of scene and reference; ValueError if the name is not "scenes/{scene}/references/{reference}"."""
    parts = name.split("/", 3)
    if len(parts) != 4 or parts[0] != "scenes" or parts[2] != "references":
        raise ValueError(f"must be scenes/{{scene}}/references/{{reference}}, got {shown(name)}")
    return check_id(parts[1]), check_id(parts[3])


def shown(value: str) -> str:
    """A value as error messages quote it: escaped and truncated."""
    if len(value) > _SHOWN_CHARACTERS:
        return f"{value[:_SHOWN_CHARACTERS]!a}... ({len(value)} characters)"
    return ascii(value)
