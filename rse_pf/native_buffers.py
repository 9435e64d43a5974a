"""The memory that each thread lends to the native codec, so that no call allocates any."""

from __future__ import annotations

import struct
import threading
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from rse_pf.native import address_of

__all__ = ["SLACK", "CallBuffers"]

SLACK = 64
"""Bytes behind a text that the native core may write to."""

# rse_pf_codec_call: text, its room, numbers, their room.
_HEAD = struct.Struct("=QqQq")


class CallBuffers(threading.local):
    """One call of `rse_pf.wire.native_codec` with room for a text and for numbers, in each thread another.

    Only what a message touches takes memory.
    """

    HEAD_BYTES: ClassVar[int] = _HEAD.size

    def __init__(self, call_bytes: int, *, text_room: int, numbers_room: int) -> None:
        call = np.zeros(call_bytes, dtype=np.uint8)
        self.text = np.empty(text_room + SLACK, dtype=np.uint8)
        self.numbers = np.empty(numbers_room, dtype=np.float64)
        self.call = memoryview(call)  # type: ignore[arg-type]
        self.text_view = memoryview(self.text)  # type: ignore[arg-type]
        self.number_bytes = memoryview(self.numbers).cast("B")  # type: ignore[arg-type]
        self.call_at, self.text_at = address_of(call), address_of(self.text)
        self.lend(self.text)

    def lend(self, text: npt.NDArray[np.uint8]) -> None:
        """Make the next calls write to *text*, whose last `SLACK` bytes stay free."""
        _HEAD.pack_into(
            self.call, 0, address_of(text), len(text) - SLACK, address_of(self.numbers), len(self.numbers)
        )
