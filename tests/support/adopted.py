"""A scene that adopts, and adopted references of it, for tests of stores."""

from dataclasses import replace

import numpy as np

from mapless import Accuracy, AdoptionPolicy, Provenance, Voucher
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, ReferenceRecord, SceneAttributes, Store, adoption
from support.stores import make_reference

HALL = SceneKey("hall")
ADOPTING = SceneAttributes(adoption=AdoptionPolicy(most_per_place=2))
VOUCHERS = (Voucher("a", 40), Voucher("b", 20))
RADII = Accuracy(0.01, 0.02, 0.1, 0.2)
COVARIANCE = (np.diag([1e-4] * 3 + [1e-6] * 3) + 1e-6 * np.eye(6)[::-1]).tolist()


def adopted(
    name: str, usefulness: float = 0.2, vouchers: tuple[Voucher, ...] = VOUCHERS, adopted_by: str = ""
) -> NewReference:
    provenance = Provenance("ADOPTED", RADII, 0.5, vouchers, COVARIANCE)
    its = make_reference(name)
    return replace(its, provenance=provenance, usefulness=usefulness, adopted_by=adopted_by)


def hall(store: Store) -> dict[str, str]:
    """A scene that adopts, with two surveyed references; their keys."""
    store.create_scene(HALL, ADOPTING)
    return {it.reference_id: it.key for it in store.add_references(HALL, [make_reference("a"), make_reference("b")])}


def adopt(store: Store, new: NewReference, most_per_place: int = 9) -> tuple[ReferenceRecord, frozenset[str]]:
    """Adopts a photograph in `HALL`, by its vouchers as they are stored now; at the place of a unless it has one."""
    keys = store.find_keys(HALL, [it.reference_id for it in new.provenance.vouchers])
    placed = new if new.place_key else replace(new, place_key=store.find_keys(HALL, ["a"])["a"])
    return adoption.adopt(store, HALL, placed, keys.values(), most_per_place)
