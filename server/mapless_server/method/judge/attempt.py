"""An attempt at a photograph's pose: its features, references, matches and solver."""

from dataclasses import dataclass, replace
from enum import Enum

from ..pairs.pair import Matching


class Raster(Enum):
    """The raster of the photograph in which features are found."""

    AS_IS = "as is"
    REDUCED = "reduced"
    TURNED = "turned"


class Where(Enum):
    """Which references are used."""

    LIKELY = "likely"
    """Those that the caller names, or those that resemble the photograph, where soft priors say that it is."""
    NEAR_PRIOR = "near the prior"
    ONE_PLACE = "one place"
    """Those of the only one of two places that the priors allow."""
    ANYWHERE = "anywhere"
    """Those that resemble the photograph, whatever soft priors say."""


class Solver(Enum):
    """The matches that give the pose."""

    POINTS = "points"
    """2D-3D matches; with one reference, those with the depths of a network."""
    LINES = "lines"
    """Matches with single references and 2D-3D matches together, see `pose.two_view`."""


@dataclass(frozen=True)
class Attempt:
    """One way to compute a photograph's pose; equal attempts give the same result.

    Attributes:
        features: index of the features, the cheapest first.
        raster: where they are found in the photograph.
        angle_deg: by how much the raster is turned clockwise.
        where: which references are used.
        matching: how the photographs are matched.
        solver: which matches give the pose.
        uses_priors: whether priors take part in the pose.
    """

    features: int = 0
    raster: Raster = Raster.AS_IS
    angle_deg: float = 0.0
    where: Where = Where.LIKELY
    matching: Matching = Matching.STRICT
    solver: Solver = Solver.POINTS
    uses_priors: bool = True

    @property
    def basis(self) -> "Attempt":
        """The attempt whose photographs and features it uses: attempts of one basis differ in what follows."""
        return Attempt(self.features, self.raster, self.angle_deg, self.where)

    def but(self, **changes: object) -> "Attempt":
        """A copy with these values."""
        return replace(self, **changes)  # type: ignore[arg-type]
