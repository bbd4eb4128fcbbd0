"""The seam: a global descriptor is a name and one method that makes a unit vector of a photograph."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless_server.method.views import View

Vector = NDArray[np.float32]
"""(D,) of unit length, so that a dot product is a similarity, -1 to 1; all zero where nothing is to be seen."""


class GlobalDescriptor(Protocol):
    """Describes a whole photograph by one vector.

    Attributes:
        name: identifies the descriptor and everything that changes what it computes; the key of stored vectors.
        dimension: D, the length of its vectors.
        extractor: name of the local features that it is made of; None where it looks at pixels.
    """

    @property
    def name(self) -> str:
        """See the class."""
        ...

    @property
    def dimension(self) -> int:
        """See the class."""
        ...

    @property
    def extractor(self) -> str | None:
        """See the class."""
        ...

    def describe(self, view: View) -> Vector:
        """The vector (D,) of a view; its photograph is needed where the descriptor looks at pixels.

        A view without anything to describe (a blank wall) gives zeros, which resemble nothing.
        """
        ...
