"""From the numbers of a `pnp` command to the bytes of its reply, in one call of the native core.

The pose is that of `rse_pf.native.NativeSolver.solve_flat`, and the bytes are those of the reply that the
service makes of it.
"""

from __future__ import annotations

import ctypes
import struct
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.native import (
    POSE_AT,
    REASONS,
    RESULT,
    RESULT_BYTES,
    NativeOptions,
    address_of,
    load_part,
    packed_request,
    solver_error,
)
from rse_pf.wire.native_codec import CODEC_ABI
from rse_pf.wire.plain_pnp import EncodedReply, PlainPnp

__all__ = ["ReplySolver", "open_reply_solver"]

_JSON, _MSGPACK = 0, 2
# rse_pf_codec_answer: inliers, their room, reply, its room | rse_pf_pnp_result.
_HEAD = struct.Struct("=QqQq")
_MAX_ROWS = 8192
"""Commands of more rows are solved elsewhere."""
_REPLY_ROOM = 1 << 16

_request = lru_cache(maxsize=256)(packed_request)


class _Buffers(threading.local):
    """What one thread lends to a call, with views of its parts."""

    def __init__(self) -> None:
        self.inliers, self.reply = np.empty(_MAX_ROWS, dtype=np.int64), np.empty(_REPLY_ROOM, dtype=np.uint8)
        answer = bytearray(_HEAD.size + RESULT_BYTES)
        _HEAD.pack_into(answer, 0, address_of(self.inliers), _MAX_ROWS, address_of(self.reply), _REPLY_ROOM)
        self.answer_at = ctypes.addressof(ctypes.c_char.from_buffer(answer))
        self.reply_view = memoryview(self.reply)  # type: ignore[arg-type]
        result = memoryview(answer)[_HEAD.size :]
        self.result = result
        self.status_and_reason = result[:8].cast("i")
        self.pose = result[POSE_AT : POSE_AT + 16 * 8]


class ReplySolver:
    """The solver of one loaded library, from numbers to bytes; every thread may call it."""

    def __init__(self, solve: Any) -> None:
        self._solve = solve
        self._buffers = _Buffers()

    def answer(self, read: PlainPnp, options: NativeOptions) -> EncodedReply | None:
        """Estimate the camera pose of *read*, whose own options and depths are not looked at.

        Returns:
            The reply in the encoding of the command; None for numbers that do not fit, too many rows, or a
            reply that its encoding has no number for.

        Raises:
            RsePfError: As `rse_pf.native.NativeSolver.solve` does.
        """
        rows = read.pixels // 2
        if read.points != 3 * rows or read.pixels != 2 * rows:
            return None
        buffers = self._buffers
        size: int = self._solve(
            _request(read.camera, options), read.numbers, rows, _JSON if read.is_text else _MSGPACK,
            buffers.answer_at,
        )  # fmt: skip
        status, reason = buffers.status_and_reason
        if status:
            raise solver_error(RESULT.unpack_from(buffers.result), rows, options)
        if not size:
            return None
        raw = msgspec.Raw(bytes(buffers.reply_view[:size]))
        return EncodedReply(raw, REASONS[reason], bytes(buffers.pose))


def open_reply_solver(path: Path) -> ReplySolver:
    """Load the library at *path*; raises ConfigurationError as `load_part` says."""
    (solve,) = load_part(path, "codec", CODEC_ABI, "rse_pf_codec_solve")
    integer, data = ctypes.c_int64, ctypes.c_char_p
    solve.argtypes, solve.restype = (data, data, integer, ctypes.c_int32, ctypes.c_void_p), integer
    return ReplySolver(solve)
