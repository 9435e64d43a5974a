"""Encode by which cells a floor plan differs from an earlier one, so that a robot receives few bytes.

Both plans have cells of one size, whose corners lie at multiples of this size: the change is the exclusive or
of the cells that cover the same square, compressed by zlib.  Cells outside the earlier plan count as unknown.
"""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadMessage
from rse_pf.slam.occupancy import MAX_CELLS, UNKNOWN, OccupancyGrid

__all__ = ["decode_change", "encode_change"]

Cells = npt.NDArray[np.uint8]
_LEVEL = 6  # compression of zlib: higher levels take longer, and save less than 2 % of a plan


def encode_change(base: OccupancyGrid | None, plan: OccupancyGrid) -> bytes:
    """Return by which cells *plan* differs from *base*; None for *base* means a plan without known cells."""
    before = _cells_at(base, plan.cells.shape, plan.origin_m)
    return zlib.compress((plan.cells ^ before).tobytes(), _LEVEL)


def decode_change(
    base: OccupancyGrid | None, data: bytes, shape: tuple[int, int], origin_m: tuple[float, float]
) -> Cells:
    """Return the cells ``(rows, columns)`` of the plan that `encode_change` encoded.

    Args:
        base: The earlier plan that the encoder used.
        data: What the encoder returned.
        shape: Rows and columns of the plan.
        origin_m: x and y of its corner, as in `OccupancyGrid`.

    Raises:
        BadMessage: *data* are damaged, or no plan of this shape.
    """
    size = shape[0] * shape[1]
    if not 0 < size <= MAX_CELLS or min(shape) < 1:
        raise BadMessage(f"a floor plan has {shape[0]} x {shape[1]} cells, not 1 to {MAX_CELLS}")
    decompressor = zlib.decompressobj()
    try:
        raw = decompressor.decompress(data, size + 1)
    except zlib.error as error:
        raise BadMessage("a floor plan is damaged", hint="ask for it again") from error
    if len(raw) != size:
        raise BadMessage(f"a floor plan has {len(raw)} cells or more, not {size}", hint="ask for it again")
    cells: Cells = np.frombuffer(raw, np.uint8).reshape(shape) ^ _cells_at(base, shape, origin_m)
    return cells


def _cells_at(base: OccupancyGrid | None, shape: tuple[int, ...], origin_m: tuple[float, float]) -> Cells:
    """Return the cells of *base* in a grid of another shape and origin; cells outside of it are unknown."""
    cells = np.full(shape, UNKNOWN, np.uint8)
    if base is None:
        return cells
    column, row = (round((a - b) / base.resolution_m) for a, b in zip(base.origin_m, origin_m, strict=True))
    rows, base_rows = _overlap(row, base.cells.shape[0], shape[0])
    columns, base_columns = _overlap(column, base.cells.shape[1], shape[1])
    cells[rows, columns] = base.cells[base_rows, base_columns]
    return cells


def _overlap(first: int, length: int, size: int) -> tuple[slice, slice]:
    """Return which part of ``range(size)`` an interval covers, and which part of the interval that is."""
    begin, end = min(max(0, first), size), min(max(0, first + length), size)
    return slice(begin, end), slice(begin - first, end - first)
