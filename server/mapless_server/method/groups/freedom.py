"""How the photographs of a group may move together."""

from __future__ import annotations

from typing import Protocol, TypeVar

from mapless.geometry import Array, RigidTransform

F = TypeVar("F", bound="Freedom")


class Freedom(Protocol):
    """How the photographs of a group may move, and what holds them together; a point in its parameters' space.

    Attributes:
        size: number N of parameters.
    """

    @property
    def size(self) -> int:
        """See the class."""
        ...

    def camera_from_world(self, image: int) -> RigidTransform:
        """Of one photograph."""
        ...

    def jacobian(self, image: int) -> Array:
        """(6, N): the left perturbation (v, w) of its camera_from_world by the parameters."""
        ...

    def moved(self: F, step: Array) -> F:
        """After a step (N,) of the parameters."""
        ...

    def relaxed(self: F) -> F:
        """The same point, with what holds the photographs together believed as far as it has turned out to be true."""
        ...

    def cost(self) -> float:
        """Of what holds the photographs together."""
        ...

    def equations(self) -> tuple[Array, Array]:
        """J^T J (N, N) and J^T r (N,) of the same."""
        ...
