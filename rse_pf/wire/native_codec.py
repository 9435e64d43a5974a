"""The codecs' hot path in the native core: guards, inflating, and a `pnp` command as arrays, in one call.

What the core does not plainly know it leaves to `rse_pf.wire.codec`, having judged it by the same budget; its
refusals are those of `rse_pf.budget`.  Everything works without it.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from rse_pf.budget import Budget, Refusal, refusal
from rse_pf.errors import RsePfError
from rse_pf.native import load_part, open_found
from rse_pf.native_buffers import SLACK, CallBuffers
from rse_pf.wire.messages import Command
from rse_pf.wire.plain_pnp import PlainPnp

__all__ = ["CODEC_ABI", "NativeCodec", "NativeReader", "PnpTypes", "native_codec", "open_codec"]

CODEC_ABI = 4
_NAMES = "rse_pf_codec_check", "rse_pf_codec_read", "rse_pf_codec_deflate"
_READ, _NOT_MINE, _NEEDS_ROOM, _UNKNOWN = 0, 1, 11, 12
_ENCODINGS = {"json": 0, "zlib": 1, "bin": 2}
_TEXT_ROOM, _NUMBERS_ROOM = 1 << 20, 1 << 16
_HOLDS_LOCK_BYTES = 16384
"""Shorter messages are read without giving the interpreter lock away, which others might keep for longer."""

# rse_pf_codec_call: buffers | what was found | camera and options.
_FOUND = struct.Struct("=qqqqqqqdqqqqq")
_HEAD = struct.Struct("=ddddqqqddqq16s")
_FOUND_AT = CallBuffers.HEAD_BYTES
_HEAD_AT = _FOUND_AT + _FOUND.size
_CALL_BYTES = _HEAD_AT + _HEAD.size
_FOUND_WITH_HEAD = struct.Struct(f"{_FOUND.format}{_HEAD.size}s")
_HAS_DEADLINE, _HAS_KEEP, _HAS_OPTIONS, _HAS_ENGINE = 1, 2, 4, 8
_OPTION_FIELDS = {16: "inlier_px", 128: "confidence", 32: "max_iterations", 64: "min_iterations"}

_JSON_REFUSALS: dict[int, Refusal] = {
    2: "json-containers", 3: "json-depth", 4: "values", 5: "memory", 8: "not-zlib", 9: "not-one-stream",
    10: "bomb", 13: "blocks",
}  # fmt: skip
_MSGPACK_REFUSALS: dict[int, Refusal] = {
    2: "containers",
    3: "depth",
    4: "values",
    6: "cut-off",
    7: "followed",
}


class PnpTypes(NamedTuple):
    """The types of the service `pnp`, which stands above this package.

    With ``stays_plain`` a payload is a `PlainPnp`, for a caller that knows it; otherwise it is the request.
    """

    request: Callable[..., Any]
    camera: type[Any]
    options: type[Any]
    reply: type[Any]
    stays_plain: bool = False


class NativeCodec:
    """The codecs' part of one loaded library; every thread may call it."""

    def __init__(self, path: Path) -> None:
        self.short, self.long = _functions(ctypes.PyDLL(str(path))), _functions(ctypes.CDLL(str(path)))
        """The functions that keep the interpreter's lock, and those that give it away."""
        self.buffers = CallBuffers(_CALL_BYTES, text_room=_TEXT_ROOM, numbers_room=_NUMBERS_ROOM)

    def deflate(self, text: bytes) -> bytes:
        """Return *text*, mostly numbers, as a zlib stream of literals in a code of their own."""
        room, buffers = 2 * len(text) + 256, self.buffers
        if room > _TEXT_ROOM:
            larger = ctypes.create_string_buffer(room)
            return larger.raw[: self.long.deflate(text, len(text), ctypes.addressof(larger), room)]
        return bytes(buffers.text_view[: self.short.deflate(text, len(text), buffers.text_at, room)])


class NativeReader:
    """Read and judge what robots send in one encoding."""

    def __init__(
        self,
        native: NativeCodec,
        encoding: str,
        budget: Budget,
        types: PnpTypes | None,
        *,
        short_bytes: int = 0,
    ) -> None:
        """Prepare to read.

        Args:
            native: The library.
            encoding: ``json``, ``zlib`` or ``bin``.
            budget: The limits.
            types: What a `pnp` command is read as; without them no command is.
            short_bytes: What inflates to more is not read; 0 is no such limit.
        """
        self._short_bytes = short_bytes
        self._native, self._budget, self._types = native, budget, types
        self._code, self._is_deflated, self._is_json = (
            _ENCODINGS[encoding],
            encoding == "zlib",
            encoding != "bin",
        )
        self._limits = struct.pack(
            "=qqdqqqqqq", budget.inflated_bytes, budget.free_bytes, budget.inflate_ratio, budget.depth,
            budget.containers, budget.values, budget.mixed_values, budget.memory_bytes, short_bytes,
        )  # fmt: skip

    def check(self, data: bytes | bytearray) -> bool:
        """Judge JSON text, or one MessagePack value, by the budget.

        Returns:
            Whether it was judged; deeper limits than 255 levels are not known here.

        Raises:
            LimitExceeded: It holds more than the budget allows.
            BadMessage: MessagePack that ends within a value, or that bytes follow.
        """
        native = self._native
        calls = native.short if len(data) < _HOLDS_LOCK_BYTES else native.long
        data = data if type(data) is bytes else bytes(data)
        encoding = _ENCODINGS["json" if self._is_json else "bin"]
        status = calls.check(data, len(data), self._limits, encoding)
        if status not in (_NOT_MINE, _UNKNOWN):
            raise self._refusal(status, len(data), 0)
        return bool(status == _NOT_MINE)

    def read(self, data: bytes) -> Command | bytes | memoryview | Literal["longer"] | None:
        """Inflate a message from a robot if it is deflated, judge it, and read it if it is a plain one.

        Args:
            data: As received; its size is judged already.

        Returns:
            The command, if it is a plain one of `pnp`; else the bytes that are to be decoded, until the next
            call of this thread; ``longer`` if it inflates to more than *short_bytes*; None if it has to be
            judged elsewhere.

        Raises:
            LimitExceeded: It holds more than the budget allows.
            BadMessage: It is not one zlib stream, or ends within a value.
        """
        native = self._native
        if type(data) is not bytes:
            data = bytes(data)
        size, buffers = len(data), native.buffers
        calls = native.short if size < _HOLDS_LOCK_BYTES else native.long
        text: bytes | memoryview = buffers.text_view if self._is_deflated else data
        status = calls.read(data, size, self._limits, self._code, buffers.call_at)
        if status == _NEEDS_ROOM:
            if self._short_bytes:
                return "longer"
            status, text = self._with_more_room(data)
        sizes = _FOUND_WITH_HEAD.unpack_from(buffers.call, _FOUND_AT)
        if status == _READ and self._types is not None:
            command = _command(buffers, sizes, text, self._types, is_text=self._is_json)
            if command is not None:
                return command
        elif status == _UNKNOWN:
            return None
        elif status not in (_READ, _NOT_MINE):
            raise self._refusal(status, size, sizes[1])
        return text[: sizes[0]] if self._is_deflated else data

    def _with_more_room(self, data: bytes) -> tuple[int, memoryview]:
        """Inflate again; a bomb shows itself in the first part, so that no more memory is taken for it."""
        budget, buffers = self._budget, self._native.buffers
        most = max(budget.free_bytes, int(len(data) * budget.inflate_ratio))
        for room in (min(budget.inflated_bytes, budget.free_bytes), min(budget.inflated_bytes, most)):
            text = np.empty(room + SLACK, dtype=np.uint8)
            buffers.lend(text)
            status: int = self._native.long.read(data, len(data), self._limits, self._code, buffers.call_at)
            if status != _NEEDS_ROOM:
                break
        buffers.lend(buffers.text)
        return status, memoryview(text)  # type: ignore[arg-type]

    def _refusal(self, status: int, size: int, limit: int) -> RsePfError:
        reason = (_JSON_REFUSALS if self._is_json else _MSGPACK_REFUSALS)[status]
        return refusal(reason, self._budget, size=size, max_bytes=limit)


class _Calls(NamedTuple):
    check: Any
    read: Any
    deflate: Any


def _functions(library: ctypes.CDLL) -> _Calls:
    integer, pointer, text = ctypes.c_int64, ctypes.c_void_p, ctypes.c_char_p
    check, read, deflate = (library[name] for name in _NAMES)
    check.argtypes, check.restype = (text, integer, text, ctypes.c_int32), ctypes.c_int32
    read.argtypes, read.restype = (text, integer, text, ctypes.c_int32, pointer), ctypes.c_int32
    deflate.argtypes, deflate.restype = (text, integer, pointer, integer), integer
    return _Calls(check, read, deflate)


def _command(
    buffers: CallBuffers,
    numbers_found: tuple[Any, ...],
    text: bytes | memoryview,
    types: PnpTypes,
    *,
    is_text: bool,
) -> Command | None:
    """Return the command that a call has read; None if the camera or the options have invalid values."""
    (
        _, _, points, pixels, depths, identity, seq, deadline_ms, fields,
        stream_at, stream_bytes, trace_at, trace_bytes, head,
    ) = numbers_found  # fmt: skip
    try:
        camera, options = _head(types, head)
    except (RsePfError, msgspec.ValidationError):
        return None
    numbers = buffers.number_bytes[: 8 * (points + pixels + depths)].tobytes()
    payload: Any = PlainPnp(numbers, points, pixels, depths, camera, options, is_text, types.request)
    return Command(
        id=identity,
        service="pnp",
        payload=payload if types.stays_plain else payload.request(),
        stream=str(text[stream_at : stream_at + stream_bytes], "ascii") if stream_bytes else "",
        seq=seq,
        keep=bool(fields & _HAS_KEEP),
        deadline_ms=deadline_ms if fields & _HAS_DEADLINE else None,
        trace=str(text[trace_at : trace_at + trace_bytes], "ascii") if trace_bytes else "",
    )


@lru_cache(maxsize=256)
def _head(types: PnpTypes, head: bytes) -> tuple[Any, Any]:
    """Return the camera and the options of a request; a robot sends the same ones with every frame."""
    fx, fy, cx, cy, width, height, has, inlier_px, confidence, most, least, engine = _HEAD.unpack(head)
    camera = msgspec.convert(
        {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}, types.camera
    )
    if not has & _HAS_OPTIONS:
        return camera, None
    numbers = dict(zip(_OPTION_FIELDS, (inlier_px, confidence, most, least), strict=True))
    chosen: dict[str, Any] = {name: numbers[bit] for bit, name in _OPTION_FIELDS.items() if has & bit}
    if has & _HAS_ENGINE:
        chosen["engine"] = engine.rstrip(b"\0").decode()
    return camera, msgspec.convert(chosen, types.options)


def open_codec(path: Path) -> NativeCodec:
    """Load the codecs' part of the library at *path*; raises ConfigurationError as `load_part` says."""
    load_part(path, "codec", CODEC_ABI, *_NAMES)
    return NativeCodec(path)


@cache
def native_codec() -> NativeCodec | None:
    """Return the codec of the library that `find_library` finds, None if there is none that fits."""
    return open_found(open_codec)
