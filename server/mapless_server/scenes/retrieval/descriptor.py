"""The interface of global descriptors: one unit vector per photograph."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless_server.method.views import View

Vector = NDArray[np.float32]
"""(D,) of unit length, so that a dot product is a similarity, -1 to 1; zeros for a view without features."""


class GlobalDescriptor(Protocol):
    """Describes a whole photograph by one vector.

    Attributes:
        name: identifies the descriptor and everything that changes its vectors; the key of stored vectors.
        dimension: D, the length of its vectors.
        extractor: name of the local features that it is computed from; None if it uses pixels.
    """

    name: str
    dimension: int
    extractor: str | None

    def describe(self, view: View) -> Vector:
        """Computes the vector (D,) of a view, which needs its photograph if the descriptor uses pixels.

        A view without features (a blank wall) gives zeros, which are similar to nothing.
        """
        ...
