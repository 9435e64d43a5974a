"""Hostile maps: bytes that claim to be a map and are damaged, absurd, or expensive to decode.

Every map is small on the wire (at most half a megabyte) and the same on every machine.  None is large while
it is made: a long repetition is compressed once, as a piece that the stream holds many times.
"""

from __future__ import annotations

import functools
import math
import struct
import zlib
from typing import Any

import msgspec
import numpy as np

__all__ = ["DAMAGED_PROVENANCE", "DECODABLE", "hostile_maps"]

_MAGIC = b"RSEMAP1\n"
_PIECE_BYTES = 1 << 20
_MANY = 10_000_000
_CAMERA = {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
_POSE, _INFORMATION = np.eye(4), np.eye(6)
_FEATURE_BYTES = {"pixels": 8, "descriptors": 32, "points": 12}
_EMPTY = {
    "keyframes": b"\x90", "edges": b"\x90", "points": b"\xc4\x00", "colours": b"\xc4\x00",
    "provenance": b"\x80",
}  # fmt: skip

DAMAGED_PROVENANCE = frozenset(
    {"a text that is not UTF-8", "keys that are no text", "keys that are lists", "an unknown extension"}
)
"""Maps whose provenance is damaged, which may show only when it is asked for."""

DECODABLE = DAMAGED_PROVENANCE | {
    "2000 keyframes without features", "2000 keyframes of one feature", "a name of control characters",
}  # fmt: skip
"""Maps within every limit, which a decoder may accept; all others it must refuse."""


@functools.cache
def hostile_maps() -> dict[str, bytes]:
    """Return all hostile maps by what is wrong with them."""
    return {**_damaged(), **_floods(), **_absurd(), **_large()}


def _damaged() -> dict[str, bytes]:
    """Return bytes that are not a map."""
    whole = _top(keyframes=_list(_keyframe()))
    stored = zlib.compressobj(0).compress(b"")
    return {
        "no bytes": b"",
        "only the magic": _MAGIC,
        "another magic": b"RSEMAP9\n" + zlib.compress(whole),
        "not deflated": _MAGIC + whole,
        "cut off": _map(whole)[:-9],
        "bytes after the stream": _map(whole) + b"more",
        "a damaged checksum": _map(whole)[:-1] + b"\x00",
        "a stream with a dictionary": _MAGIC + b"\x78\xf9\x00\x00\x00\x01" + zlib.compress(whole)[2:],
        "empty blocks without end": _MAGIC + b"\x78\x01" + stored + b"\x00\x00\x00\xff\xff" * 80_000,
        "an empty stream": _map(b""),
        "no map inside": _map(b"\x93\x01\x02\x03"),
        "the unused byte": _map(b"\xc1"),
        "values after the map": _map(whole + b"\x01"),
        "cut off inside": _map(whole[:-5]),
        "a field that is missing": _map(b"\x81\xa9keyframes\x90"),
        "keyframes that are a map": _map(_top(keyframes=b"\x80")),
        "a provenance that is a list": _map(_top(provenance=b"\x90")),
        "a text that is not UTF-8": _map(_top(provenance=b"\x81\xa1a\xa4\xff\xfe\xc0\x80")),
        "a field twice": _map(
            b"\x86" + _top(keyframes=_list(_keyframe()))[1:] + _packed("keyframes") + _list(_keyframe())
        ),
        "keys that are no text": _map(_top(provenance=b"\x82\x01\x02\xc0\x03")),
        "keys that are lists": _map(_top(provenance=b"\x81\x91\x01\x02")),
        "an unknown extension": _map(_top(provenance=b"\x81\xa1a\xd4\x7f\x00")),
    }


def _floods() -> dict[str, bytes]:
    """Return small bytes that become many objects, a deep one or a long one."""
    length = struct.pack(">I", 1 << 26)
    deep = b"\x91" * 1_000_000 + b"\x01"
    keys = b"".join(b"\xa5%05x\x90" % number for number in range(120_000))
    return {
        "ten million empty lists": _many(b"\x90"),
        "ten million empty maps": _many(b"\x80"),
        "ten million nothings": _many(b"\xc0"),
        "ten million small numbers": _many(b"\x07"),
        "ten million empty texts": _many(b"\xa0"),
        "ten million letters": _many(b"\xa1a"),
        "ten million large numbers": _many(b"\xcf\xff\xff\xff\xff\xff\xff\xff\xff"),
        "ten million pairs": _many(b"\x92\x01\x02"),
        "keys": _map(_top(provenance=b"\xdf" + struct.pack(">I", 120_000) + keys)),
        "a text of 64 MiB": _made_by(b"\xdb" + length, b"a", 1 << 26),
        "bytes of 64 MiB": _made_by(b"\xc6" + length, b"\0", 1 << 26),
        "a key of 64 MiB": _long("provenance", b"\x81\xdb" + length, b"k", 1 << 26, b"\1"),
        "lists a million deep": _map(_top(provenance=b"\x81\xa1a" + deep)),
        "maps a million deep": _made_by(b"", b"\x81\xa1a", 1_000_000, b"\x01"),
        "lists a thousand deep": _map(_top(provenance=b"\x81\xa1a" + b"\x91" * 1000 + b"\x01")),
        "a keyframe a million deep": _map(_top(keyframes=deep)),
        "an unknown field of many lists": _long("other", b"\xdd" + struct.pack(">I", _MANY), b"\x90", _MANY),
        "an unknown field that is deep": _map(_top(other=deep)),
        "a keyframe with an unknown field": _one(other=[[]] * 500_000),
        "an announced list": _map(_top(provenance=b"\x81\xa1a\xdd\x7f\xff\xff\xff")),
        "an announced map": _map(_top(provenance=b"\xdf\xff\xff\xff\xff")),
        "an announced text": _map(_top(provenance=b"\x81\xa1a\xdb\xff\xff\xff\xff")),
        "an announced extension": _map(_top(provenance=b"\x81\xa1a\xc9\xff\xff\xff\xff\x01")),
        "announced bytes": _map(_top(points=b"\xc6\xff\xff\xff\xff")),
        "announced keyframes": _map(_top(keyframes=b"\xdd\xff\xff\xff\xff")),
        "announced edges": _map(_top(edges=b"\xdd\xff\xff\xff\xff")),
    }


def _absurd() -> dict[str, bytes]:
    """Return small maps with a value that no honest map has."""
    nan, infinite, huge, mirrored = _POSE.copy(), _POSE.copy(), _POSE.copy(), _POSE.copy()
    nan[0, 0], infinite[0, 3], huge[0, 3], mirrored[0, 0] = math.nan, math.inf, 1e308, -1.0
    unknown = _INFORMATION.copy()
    unknown[0, 0] = math.nan
    one = np.float32(1.0).tobytes()
    nans = np.full(3, np.nan, dtype=np.float32).tobytes()
    far = np.full(3, 3e38, dtype=np.float32).tobytes()
    return {
        "a pose that is not a number": _one(pose=nan.tobytes()),
        "a pose at infinity": _one(pose=infinite.tobytes()),
        "a pose at the end of the range": _one(pose=huge.tobytes()),
        "a mirrored pose": _one(pose=mirrored.tobytes()),
        "a pose of zeros": _one(pose=bytes(128)),
        "a pose of three bytes": _one(pose=b"abc"),
        "a pose that is a number": _one(pose=7),
        "a negative id": _one(id=-1),
        "an id beyond 64 bits with sign": _one(id=2**64 - 1),
        "an id with a fraction": _one(id=1.5),
        "an id that is a text": _one(id="1"),
        "a time that is not a number": _one(timestamp_s=math.nan),
        "a time at infinity": _one(timestamp_s=-math.inf),
        "a time at the end of the range": _one(timestamp_s=1e308),
        "a camera of negative size": _one(camera=_CAMERA | {"width": -640}),
        "a camera that is not a number": _one(camera=_CAMERA | {"fx": math.nan}),
        "a camera as large as the range": _one(camera=_CAMERA | {"width": 2**62, "height": 2**62}),
        "pixels that are not numbers": _one(pixels=nans[:8]),
        "rows that do not fit": _one(pixels=bytes(16)),
        "half a row": _one(pixels=bytes(7), descriptors=bytes(31), points=bytes(11)),
        "a name of a million letters": _one(robot="r" * 1_000_000),
        "a name of control characters": _one(robot="r\x1b[2J\r\n\x07\x9b\u202e"),
        "two keyframes of one id": _map(_top(keyframes=_list(_keyframe(), _keyframe()))),
        "an edge to nowhere": _two_and(b=99),
        "an edge of a negative id": _two_and(a=-5),
        "an edge of another kind": _two_and(kind="wormhole"),
        "an edge that is not a number": _two_and(step=nan.tobytes()),
        "an information that is not a number": _two_and(information=unknown.tobytes()),
        "points that are not numbers": _map(_top(points=_packed(nans), colours=_packed(bytes(3)))),
        "points at the end of the range": _map(_top(points=_packed(far), colours=_packed(bytes(3)))),
        "points without colours": _map(_top(points=_packed(one * 3))),
        "half a point": _map(_top(points=_packed(one * 2), colours=_packed(bytes(2)))),
    }


def _large() -> dict[str, bytes]:
    """Return maps whose form is right, with too much of it or deflated too well."""
    many = struct.pack(">I", 100_000)
    bare = [_keyframe(number, 0) for number in range(2000)]
    small = [_keyframe(number) for number in range(2000)]
    return {
        "one keyframe of 500,000 features": _keyframes(1, 500_000),
        "one keyframe of 5,000,000 features": _keyframes(1, 5_000_000),
        "300 keyframes of 18,000 features": _keyframes(300, 18_000),
        "2000 keyframes without features": _map(_top(keyframes=_list(*bare))),
        "2000 keyframes of one feature": _map(_top(keyframes=_list(*small))),
        "100,000 keyframes of one id": _long("keyframes", b"\xdd" + many, _keyframe(1, 0), 100_000),
        "100,000 edges": _long("edges", b"\xdd" + many, _edge(), 100_000),
        "ten million edges announced": _long("edges", b"\xdd" + struct.pack(">I", _MANY), _edge(), 1000),
        "colours of zeros": _long("colours", b"\xc6" + struct.pack(">I", 200 << 20), b"\0", 200 << 20),
        "points of zeros": _long("points", b"\xc6" + struct.pack(">I", 200 << 20), b"\0", 200 << 20),
        "zeros without a form": _MAGIC + _Deflated().add(b"\0", 300 << 20).stream(),
    }


class _Deflated:
    """A zlib stream that is written in pieces; equal pieces are compressed once."""

    def __init__(self) -> None:
        self._parts = [b"\x78\xda"]
        self._checksum = 1

    def add(self, data: bytes, times: int = 1) -> _Deflated:
        """Append *data*, *times* in a row."""
        per_piece = max(1, min(times, _PIECE_BYTES // max(1, len(data))))
        pieces = [data * per_piece] * (times // per_piece) + [data * (times % per_piece)]
        for piece in filter(None, pieces):
            self._parts.append(_compressed(piece))
            self._checksum = zlib.adler32(piece, self._checksum)
        return self

    def stream(self) -> bytes:
        """Return the whole stream."""
        return b"".join(self._parts) + b"\x03\x00" + struct.pack(">I", self._checksum)


@functools.lru_cache(maxsize=8)
def _compressed(piece: bytes) -> bytes:
    compressor = zlib.compressobj(9, zlib.DEFLATED, -15)
    return compressor.compress(piece) + compressor.flush(zlib.Z_FULL_FLUSH)


def _packed(value: Any) -> bytes:
    return msgspec.msgpack.encode(value)


def _map(body: bytes) -> bytes:
    return _MAGIC + zlib.compress(body, 9)


def _top(**fields: bytes) -> bytes:
    """Return a map whose *fields* are MessagePack already and come last; the other ones are empty."""
    whole = {name: value for name, value in _EMPTY.items() if name not in fields} | fields
    return bytes([0x80 + len(whole)]) + b"".join(_packed(name) + value for name, value in whole.items())


def _list(*items: bytes) -> bytes:
    return b"\xdd" + struct.pack(">I", len(items)) + b"".join(items)


def _fields(number: int, features: int) -> dict[str, Any]:
    return {
        "id": number, "robot": "robot-1", "timestamp_s": 1.0, "pose": _POSE.tobytes(), "camera": _CAMERA,
        **{name: bytes(size * features) for name, size in _FEATURE_BYTES.items()},
    }  # fmt: skip


def _keyframe(number: int = 1, features: int = 1, **other: Any) -> bytes:
    return _packed(_fields(number, features) | other)


def _edge(**other: Any) -> bytes:
    fields = {"a": 1, "b": 2, "step": _POSE.tobytes(), "information": _INFORMATION.tobytes(), "kind": "loop"}
    return _packed(fields | other)


def _one(**other: Any) -> bytes:
    """Return a map of one keyframe with these fields."""
    return _map(_top(keyframes=_list(_keyframe(**other))))


def _two_and(**other: Any) -> bytes:
    """Return a map of two keyframes and an edge with these fields."""
    return _map(_top(keyframes=_list(_keyframe(1), _keyframe(2)), edges=_list(_edge(**other))))


def _long(field: str, before: bytes, unit: bytes, times: int, after: bytes = b"") -> bytes:
    """Return a map whose *field*, its last one, is *before*, then *unit* many times, then *after*."""
    return _MAGIC + _Deflated().add(_top(**{field: before})).add(unit, times).add(after).stream()


def _made_by(before: bytes, unit: bytes, times: int, after: bytes = b"") -> bytes:
    """Return a map with a provenance of one key."""
    return _long("provenance", b"\x81\xa1a" + before, unit, times, after)


def _many(unit: bytes) -> bytes:
    """Return a map with a list of ten million equal values in its provenance."""
    return _made_by(b"\xdd" + struct.pack(">I", _MANY), unit, _MANY)


def _keyframes(count: int, features: int) -> bytes:
    """Return a map of *count* keyframes with *features* features each, all of zeros."""
    stream = _Deflated().add(_top(keyframes=b"\xdd" + struct.pack(">I", count)))
    for number in range(count):
        fields = _fields(number, 0)
        begin = {name: value for name, value in fields.items() if name not in _FEATURE_BYTES}
        head = bytes([0x80 + len(fields)]) + _packed(begin)[1:]
        for name, size in _FEATURE_BYTES.items():
            stream.add(head + _packed(name) + b"\xc6" + struct.pack(">I", size * features))
            stream.add(b"\0", size * features)
            head = b""
    return _MAGIC + stream.stream()
