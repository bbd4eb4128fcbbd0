"""Persistence: scenes and references with their images and features, in one transactional database.

May import security, method and images. Begin with `Store` (store.py), whose values are in `records`; `tables` is the
schema. The scenes that one query searches are found in `scene_groups`. Results of work in the background are in `pairs`
(matches of pairs of references) and `calibrations`; `adoption` keeps what localized photographs add to references, and
say of them, `counts` how they were answered. Rows become values in `rows` and `codec`, which check every byte. `sqlite`
and `postgresql` are the databases; `backup` and `verify` are what the `store` commands do.
"""

from mapless_server.cache import LruCache

from .database import StoreError
from .records import (
    ContradictingDown,
    DatumWithoutMetres,
    DescribedReference,
    GroupedScene,
    IndexedReference,
    NamedScenes,
    NewReference,
    ReferenceRecord,
    Retirement,
    RetirementReason,
    SceneAttributes,
    SceneChanges,
    SceneRecord,
    SceneState,
    SelfCalibration,
    WrongRadius,
    calibration_kind,
)
from .rows import time_us
from .store import Store
