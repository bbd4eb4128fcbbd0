"""Persistence: scenes and references with their images and features, in one transactional database.

May import security, method and images. Begin with `Store` (store.py), whose values are in `records` and `attributes`;
`tables` is the schema. The scenes that one query searches are found in `scene_groups`. A scene's generation is raised,
and what changed since one is read, in `changes`. Results of work in the background are in `pairs` (matches of pairs of
references) and `calibrations`; `adoption` keeps what localized photographs add to references, and say of them, `counts`
how they were answered. Rows become values in `rows` and `codec`, which check every byte. `sqlite` and `postgresql` are
the databases; `backup` and `verify` are what the `store` commands do.
"""

from mapless_server.cache import LruCache

from .attributes import (
    ContradictingDown,
    DatumWithoutMetres,
    SceneAttributes,
    SelfCalibration,
    WrongRadius,
    calibration_kind,
)
from .database import StoreError
from .records import (
    DescribedReference,
    GroupedScene,
    IndexedReference,
    NamedScenes,
    NewReference,
    ReferenceRecord,
    Retirement,
    RetirementReason,
    SceneChanges,
    SceneRecord,
    SceneState,
)
from .rows import time_us
from .store import Store
