"""The options of placing photographs in a scene; they check themselves."""

from dataclasses import dataclass, field

from mapless_server.bounds import check_bounds
from mapless_tools.reconstruct.run import ReconstructOptions


@dataclass(frozen=True)
class ExtendOptions:
    """Options of placing photographs.

    Attributes:
        reconstruct: the features, lenses and pairs that are compared, as for `mapless-server reconstruct`.
        similar: of scenes with more references than `reconstruct.pairs.all_below`, so many for each photograph are
            used: those that are most similar to it.
        least_observations: fewer points of the scene that a photograph sees do not confirm its pose; twice COLMAP's
            least for finding one.
        largest_radius: largest radius of 95 % of a position that is stored, as a share of the distance to what the
            photograph shows: as a reference it misleads by as much.
        least_agreeing: least share of the photographs with matches whose poses these fit; with fewer the photograph
            shows something that is in the scene twice.
    """

    reconstruct: ReconstructOptions = field(default_factory=ReconstructOptions)
    similar: int = 20
    least_observations: int = 60
    largest_radius: float = 0.05
    least_agreeing: float = 0.5

    def __post_init__(self) -> None:
        check_bounds(self, "similar least_observations", at_least=1)
        check_bounds(self, "largest_radius", above=0)
        check_bounds(self, "least_agreeing", at_least=0, at_most=1)
