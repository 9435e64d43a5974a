"""The vector by which the place of an image is recognised, computed once and when it is first needed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from client_sdk.slots import LoopsSlot
from rse_pf.maps.descriptors import Descriptors
from rse_pf.slam.place_recognition import PlaceVector, place_vector

__all__ = ["Place", "place_of"]


class Place:
    """The vector of one image; what it is computed from is kept no longer than needed."""

    def __init__(self, compute: Callable[[], PlaceVector]) -> None:
        self._compute: Callable[[], PlaceVector] | None = compute
        self._vector: PlaceVector

    def vector(self) -> PlaceVector:
        """Return the ``(d,)`` unit vector."""
        if self._compute is not None:
            self._vector, self._compute = self._compute(), None
        return self._vector


def place_of(descriptors: Descriptors, rgb: npt.NDArray[np.uint8], loops: LoopsSlot | None) -> Place:
    """Return the place of an image: by a user's function, or by its descriptors."""
    if loops is None:
        return Place(lambda: place_vector(descriptors))
    return Place(lambda: loops(rgb))
