"""References of answers, from a server that is asked only for answers that name some."""

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass

from mapless import Client, DataLoss, LocalizationResult, MaplessError, NotFound, Reference, Rejected
from mapless.geometry import Array
from mapless.names import parse_reference_name
from mapless_server.settings import load_settings
from mapless_tools.child import ServerFailed
from mapless_tools.connection import Connection, connected
from mapless_tools.plan import down_of

from .page import best_references

MAX_REFERENCES = 16
"""References of an answer on its plan."""


@dataclass(frozen=True, eq=False)
class Found:
    """References of an answer, and the direction of gravity (3,) in their scene, None without references.

    `missing` is a sentence on those that are left out; empty if none is.
    """

    references: Sequence[Reference] = ()
    down_in_world: Array | None = None
    missing: str = ""


class ReferenceSource:
    """The server of references: connected for the first answer that names some, and not asked again once it fails."""

    def __init__(self, connection: Connection, until: ExitStack) -> None:
        """The connection ends with the stack."""
        self._connection, self._until = connection, until
        self._client: Client | None = None
        self._failure = ""

    def find(self, answer: LocalizationResult | Rejected) -> Found:
        """The references of an answer, the best with their photographs.

        Those that are deleted or damaged are left out, and all if the server cannot be reached or refuses. ValueError
        or ConfigError for wrong options of the connection or settings.
        """
        names = names_of(answer)
        if not names:
            return Found()
        if not self._failure:
            try:
                return _fetched(self._connected(), names, best_references(answer))
            except (MaplessError, ServerFailed) as error:
                self._failure = f"the references are left out, because the server did not give them: {error}"
        return Found(missing=self._failure)

    def _connected(self) -> Client:
        if self._client is None:
            self._client = self._until.enter_context(connected(self._connection, load_settings({}).settings))
        return self._client


def names_of(answer: LocalizationResult | Rejected) -> list[str]:
    """Names of the references to draw: the best, then others with matches."""
    uses = sorted(answer.diagnostics.references, key=lambda use: (-use.inlier_count, -use.match_count))
    names = dict.fromkeys([*best_references(answer), *(use.name for use in uses if use.match_count)])
    return list(names)[:MAX_REFERENCES]


def _fetched(client: Client, names: Sequence[str], pictured: Sequence[str]) -> Found:
    references = []
    for name in names:
        with suppress(NotFound, DataLoss):
            references.append(client.get_reference(*parse_reference_name(name), include_image=name in pictured))
    left = len(names) - len(references)
    missing = f"{left} of {len(names)} references are left out: the server has them no more, or damaged" if left else ""
    if not references:
        return Found(missing=missing)
    scene = None
    with suppress(NotFound):
        scene = client.get_scene(references[0].scene_id)
    return Found(references, down_of(scene, [it.world_from_camera for it in references]), missing)
