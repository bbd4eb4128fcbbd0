"""The scenes of its tenant that a token is limited to."""

from collections.abc import Mapping
from dataclasses import dataclass

MAX_LIMIT_SCENES = 1000
"""Scenes that a token may name: look-ups name all of them; larger groups have labels."""


@dataclass(frozen=True)
class SceneLimit:
    """Some scenes of a tenant: those with one of the ids, and those with all of the labels, if there are labels.

    Attributes:
        scene_ids: ids of scenes, which need not exist.
        labels: labels as pairs of name and value.
    """

    scene_ids: frozenset[str] = frozenset()
    labels: frozenset[tuple[str, str]] = frozenset()

    def __post_init__(self) -> None:
        if not self.scene_ids and not self.labels:
            raise ValueError("scene_ids or labels must have at least one item")

    def holds(self, scene_id: str, labels: Mapping[str, str]) -> bool:
        """Whether a scene with this id and these labels is one of them."""
        return scene_id in self.scene_ids or (bool(self.labels) and self.labels <= labels.items())
