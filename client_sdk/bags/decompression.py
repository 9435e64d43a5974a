"""Decompress what a bag holds within bounds of memory and work; `rosbags` has none of its own.

`bound_reader` puts the functions of this module in the place of its own.  Nothing here knows messages.
"""

from __future__ import annotations

import bz2
import functools
import importlib
import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

__all__ = ["MAX_CHUNK_BYTES", "Allowance", "bound_reader", "charge"]

MAX_CHUNK_BYTES = 256 << 20
"""Of one chunk or message; writers end a chunk at some MB and one message."""
_FREE_BYTES, _RATIO = 4 << 30, 200
"""What one pass over a bag may decompress: so much, and so many times its size."""


class Allowance:
    """How many bytes one pass over a bag of *size_bytes* may still decompress."""

    def __init__(self, size_bytes: int) -> None:
        self.left_bytes = _FREE_BYTES + _RATIO * size_bytes

    def take(self, size_bytes: int) -> None:
        """Count what was decompressed; raises ValueError above the bound."""
        self.left_bytes -= size_bytes
        if self.left_bytes < 0:
            raise ValueError("it decompresses to far more than it has bytes")


_charged = Allowance(0)


def charge(allowance: Allowance) -> None:
    """Count what is decompressed from now on for *allowance*."""
    global _charged
    _charged = allowance


@functools.cache
def bound_reader() -> None:
    """Let `rosbags` decompress with the functions of this module."""
    names = ("rosbag1.reader", "rosbag2.storage_mcap", "rosbag2.reader")
    modules: list[Any] = [importlib.import_module(f"rosbags.{name}") for name in names]
    ros1, mcap, ros2 = modules
    lz4, zstd = importlib.import_module("lz4.frame").LZ4FrameDecompressor, ros2.zstd.ZstdDecompressor
    ros1.decompressors |= {
        "bz2": functools.partial(_decompress, bz2.BZ2Decompressor),
        "lz4": functools.partial(_decompress, lz4),
    }
    mcap.DECOMPRESSORS |= {
        "lz4": functools.partial(_decompress, lz4),
        "zstd": functools.partial(_decompress, zstd),
    }
    ros2.zstd = SimpleNamespace(
        decompress=functools.partial(_decompress, zstd),
        open=functools.partial(_CountedFile, ros2.zstd.open),
        ZstdError=ros2.zstd.ZstdError,
        ZstdDecompressor=zstd,
    )


def _decompress(make: Callable[[], Any], data: bytes, size: int | None = None) -> bytes:
    """Return the content of all streams in *data*; raises ValueError above *size* or the bound."""
    parts: list[bytes] = []
    max_bytes = left = MAX_CHUNK_BYTES if size is None else min(size, MAX_CHUNK_BYTES)
    while data:
        stream = make()
        part: bytes = stream.decompress(data, left + 1)
        left -= len(part)
        if left < 0:
            raise ValueError(f"a chunk or message decompresses to more than {max_bytes} bytes")
        _charged.take(len(part))
        if not stream.eof:
            raise ValueError("a chunk or message is cut off")
        parts.append(part)
        data = stream.unused_data or b""
    return parts[0] if len(parts) == 1 else b"".join(parts)


class _CountedFile(io.RawIOBase):
    """A compressed file whose content is counted while it is read."""

    def __init__(self, opened: Callable[..., Any], file: Any, mode: str) -> None:
        self._content = opened(file, mode)

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes; raises ValueError above the bound."""
        data: bytes = self._content.read(size)
        _charged.take(len(data))
        return data

    def close(self) -> None:
        """Close the file."""
        self._content.close()
        super().close()
