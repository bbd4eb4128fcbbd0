"""Names in requests, checked and made the keys and ids by which the store knows things."""

from __future__ import annotations

from collections.abc import Sequence

from mapless import names, wire
from mapless.wire import FieldError
from mapless_server.security.tenancy import SceneKey, key_of


def scene_key_from_name(name: str, field: str, tenant: str) -> SceneKey:
    """The key of a tenant's scene of this name; FieldError if it is none."""
    return key_of(tenant, wire.scene_id_from_name(name, field))


def reference_key_from_name(name: str, field: str, tenant: str) -> tuple[SceneKey, str]:
    """The key of a tenant's scene, and the reference's id within it; FieldError if the name is none."""
    scene_id, reference_id = wire.reference_ids_from_name(name, field)
    return key_of(tenant, scene_id), reference_id


def reference_ids_from_names(names_given: Sequence[str], scene_id: str, most: int) -> tuple[str, ...]:
    """Ids of the references that `references` of a request names, in order.

    Raises:
        FieldError: there are more than `most`, or one is no name, of another scene, or stands twice.
    """
    if len(names_given) > most:
        raise FieldError("references", f"must be at most {most}, are {len(names_given)}")
    reference_ids: dict[str, None] = {}
    for i, name in enumerate(names_given):
        field = f"references[{i}]"
        its_scene_id, reference_id = wire.reference_ids_from_name(name, field)
        if its_scene_id != scene_id:
            raise FieldError(field, f"{names.shown(name)} is a reference of another scene than {scene_id!r}")
        if reference_id in reference_ids:
            raise FieldError(field, f"{names.shown(name)} stands twice")
        reference_ids[reference_id] = None
    return tuple(reference_ids)
