"""Writes the features of protocol version 1, which the product only reads."""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

__all__ = ["features_v1"]


def features_v1(
    pixels: npt.NDArray[np.floating],
    depths_m: npt.NDArray[np.floating],
    descriptors: npt.NDArray[np.uint8],
    fraction: int = 4,
) -> bytes:
    """Return features as version 1 has them, pixels in units of ``2**-fraction``."""
    units = np.rint(np.asarray(pixels) * 2.0**fraction).astype("<u2")
    depths_mm = np.rint(np.asarray(depths_m) * 1000.0).astype("<u2")
    head = struct.pack("<BBH", 1, fraction, len(units))
    columns, rows = units[:, 0].tobytes(), units[:, 1].tobytes()
    return head + columns + rows + depths_mm.tobytes() + descriptors.tobytes()
