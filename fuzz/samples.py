"""Initial inputs of fuzzing: well-formed messages, frames and problems, the corpus, and expensive messages.

`EXPENSIVE` are messages within every size limit that were built to cost as much as possible.  All inputs are
the same on every machine.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.maps.format import Edge, MapVersion, decode_map, encode_map
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem
from rse_pf.processes.ipc import encode_message
from rse_pf.services.pnp import make_request
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe
from rse_pf.slam.pose_graph import write_g2o
from rse_pf.wire import Cancel, Command, Failure, Hello, Ping, Result, make_codec
from tests.kit.synthetic_maps import make_room, make_sphere, make_world
from tests.kit.two_views import make_two_views

__all__ = ["CORPUS", "EXPENSIVE", "MAX_INPUT_BYTES", "samples"]

CORPUS = Path(__file__).parent / "corpus"
"""Folder of stored inputs, in a folder for each target."""
MAX_INPUT_BYTES = 262_144
"""``session.max_message_bytes``: longer messages never reach a decoder."""


@cache
def samples(target: str) -> tuple[bytes, ...]:
    """Return the initial inputs of *target*: first those of this module, then its files in `CORPUS`."""
    kept = [file.read_bytes() for file in sorted((CORPUS / target).glob("*"))]
    return (*_MADE[target](), *kept)


def _messages() -> list[bytes]:
    problem = make_problem(seed=3, n=12)
    asked = make_request(problem.points_world, problem.pixels, KINECT)
    with_depth = make_request(
        problem.points_world, problem.pixels, KINECT, depths_m=np.linspace(0.0, 3.0, 12)
    )
    said = (
        Hello(sdk="fuzz", capabilities=("progress",)), Ping(sent_s=1.5), Cancel(id=3),
        Command(id=1, service="pnp", payload=asked, stream="camera", seq=4, deadline_ms=200.0, trace="t"),
        Command(id=5, service="pnp", payload=with_depth),
        Command(id=2, service="echo", payload={"a": [1, "x", None, {"b": 2.5}]}),
        Result(id=1, reply=[1.0, 2.0]), Failure(id=2, code="busy", message="m", retry_after_ms=5.0),
    )  # fmt: skip
    return [
        bytes([kind]) + make_codec(name).encode(message)
        for kind, name in ((0, "bin"), (1, "json"), (2, "zlib"), (3, "json"))
        for message in said
    ]


def _frames() -> list[bytes]:
    def frame(opcode: int, payload: bytes, *, fin: bool = True, pause: int = 0) -> bytes:
        return bytes([opcode | (128 if fin else 0), len(payload), pause]) + payload

    close = (1000).to_bytes(2, "big")
    talks = (
        frame(1, b"hello") + frame(9, b"?") + frame(2, b"\xff" * 20) + frame(8, close),
        frame(1, b"a", fin=False) + frame(0, b"", fin=False) + frame(9, b"") + frame(0, "é".encode()),
        frame(2, b"", fin=False) + frame(0, b"", fin=False) * 70 + frame(0, b""),
        frame(9, b"x", pause=2) * 60,
        bytes([0x80 | 32 | 2, 255, 0]) + frame(10, b"") * 3 + frame(8, close + b"bye"),
    )
    return [limits + talk for limits in (b"\x00", b"\xff") for talk in talks]


def _streams() -> list[bytes]:
    small = b"\x82\x83\1\2\3\4abc"
    long = b"\x82\xfe\x01\x00\0\0\0\0" + b"\x88" * 256
    huge = b"\x82\xff" + (5_000).to_bytes(8, "big") + b"\0\0\0\0" + b"." * 5_000
    close = b"\x88\x82\0\0\0\0\x03\xe8"
    talks = (small + close + b"more", long + small * 3 + close, huge + close + close, close, small * 9)
    return [bytes([step]) + talk for step in (0, 6, 22) for talk in talks]


def _problems() -> list[bytes]:
    found = []
    for k, kind in enumerate((*DEGENERATE, "sound")):
        if kind in ("nan", "infinite", "huge"):
            continue
        problem = make_problem(seed=k, n=20) if kind == "sound" else make_degenerate(kind, seed=k, n=20)
        numbers = problem.points_world.astype("<f8").tobytes() + problem.pixels.astype("<f8").tobytes()
        found += [bytes([engine, 20, 0, 64, 120, 250, 18, 19]) + numbers for engine in (0, 1)]
    views = make_two_views(seed=1, n=20)
    numbers = views.points_reference.astype("<f8").tobytes() + views.pixels.astype("<f8").tobytes()
    return [*found, *(bytes([engine, 20, 0, 64, 120, 250, 19, 19]) + numbers for engine in (0, 2))]


def _json(payload: bytes) -> bytes:
    return b'{"type":"command","id":1,"service":"echo","payload":' + payload + b"}"


def _binary(payload: bytes) -> bytes:
    start = msgspec.msgpack.encode({"type": "command", "id": 1, "service": "echo"})
    return bytes([start[0] + 1]) + start[1:] + b"\xa7payload" + payload


def _array(item: bytes, count: int) -> bytes:
    return _binary(b"\xdd" + count.to_bytes(4, "big") + item * count)


def _deflated(payload: bytes) -> tuple[str, bytes]:
    return "zlib", zlib.compress(_json(payload), 9)


def _text(size: int) -> bytes:
    """Return letters that deflate well, but below the limit for a compression bomb."""
    return b"".join(b"%06d%s" % (k, b"a" * 100) for k in range(size // 106))


_COUNT = 24_900  # number of entries of an expensive map
_ALL = 1_048_000  # size in bytes of an expensive text, below the limit of 1 MiB after inflation
_VALUES = 29_900  # number of texts in an expensive list
# Entries of a MessagePack map with different keys.
_PACKED_KEYS = b"".join(b"\xa5k%04x\1" % k for k in range(14_900))
# Entries of a JSON object with different keys.
_KEYS = b",".join(b'"k%d":%d' % (i, i + 1000) for i in range(_COUNT))
# Entries of a MessagePack map with numbers as keys.
_NUMBERED = b"".join(b"\xcd%c%c\x90" % divmod(i, 256) for i in range(_COUNT))
# Ten bits of an empty deflate block: not the last block, fixed codes, and the code that ends the block.
_EMPTY_BLOCK_BITS = 0b10
# Four empty deflate blocks, which fill five bytes.
_EMPTY_BLOCKS = sum(_EMPTY_BLOCK_BITS << 10 * k for k in range(4)).to_bytes(5, "little")
# Numbers of JSON with many different digits.
_DIGITS = b"".join(b"0.%016d," % (k * k * 2654435761 % 10**16) for k in range(29_000))

EXPENSIVE: dict[str, tuple[str, bytes]] = {
    "empty lists": ("bin", _array(b"\x90", 262_000)),
    "empty maps": ("bin", _array(b"\x80", 262_000)),
    "small integers": ("bin", _array(b"\x01", 262_000)),
    "numbers": ("bin", _array(b"\xcb\x3f\xf1\1\1\1\1\1\1", 29_000)),
    "short numbers": ("bin", _array(b"\xca\x3f\xf1\1\1", 49_000)),
    "letters": ("bin", _array(b"\xa1a", 130_000)),
    "byte strings": ("bin", _array(b"\xc4\x01a", 87_000)),
    "numbered maps": ("bin", _binary(b"\xdf" + _COUNT.to_bytes(4, "big") + _NUMBERED)),
    "announced list": ("bin", _binary(b"\xdd\x7f\xff\xff\xff")),
    "announced text": ("bin", _binary(b"\xdb\x7f\xff\xff\xff")),
    "deep": ("bin", _binary(b"\x91" * 260_000)),
    "json numbers": ("json", _json(b"[" + b"1.5," * 49_900 + b"1]")),
    "json words": ("json", _json(b"[" + b'"ab",' * 49_000 + b"1]")),
    "json lists": ("json", _json(b"[" + b"[]," * 9_900 + b"1]")),
    "json brackets in words": ("json", _json(b"[" + b'"",' * 80_000 + b'"",' + b"[" * 20 + b"]" * 21)),
    "json long integers": ("json", _json(b"[" + (b"9" * 4300 + b",") * 55 + b"1]")),
    "json smallest numbers": ("json", _json(b"[" + b"5e-324," * 29_000 + b"1]")),
    "json largest numbers": ("json", _json(b"[" + b"1.797e308," * 24_000 + b"1]")),
    "json middles": ("json", _json(b"[" + b"1e23," * 29_000 + b"1]")),
    "json long middles": ("json", _json(b"[" + b"9007199254740993.0," * 13_000 + b"1]")),
    "json negative integers": ("json", _json(b"[" + b"-9999999999999999999," * 11_000 + b"1]")),
    "json costly numbers that may be": ("json", _json(b"[" + b"1.797e308," * 185 + b"1]")),
    "json middles that may be": ("json", _json(b"[" + b"1e23," * 2700 + b"1]")),
    "deflated digits": ("zlib", zlib.compress(_json(b"[" + _DIGITS + b"1]"), 9)),
    "exponents in words": ("zlib", zlib.compress(_json(b'["' + _DIGITS.replace(b".", b"e") + b'"]'), 9)),
    "json backslashes": ("json", _json(b'"' + b"\\\\" * 120_000 + b'"')),
    "deflated keys": ("zlib", zlib.compress(_json(b"{" + _KEYS + b"}"), 9)),
    "deflated small maps": ("zlib", zlib.compress(_json(b"[" + b'{"a":1},' * 9_900 + b"1]"), 9)),
    "deflated words": ("zlib", zlib.compress(_json(b"[" + b'"ab",' * 49_000 + b"1]"), 9)),
    "keys that may be": _deflated(b"{" + b",".join(_KEYS.split(b",")[:14_900]) + b"}"),
    "packed keys": ("bin", _binary(b"\xde" + (14_900).to_bytes(2, "big") + _PACKED_KEYS)),
    "words that may be": _deflated(b"[" + b'"ab",' * _VALUES + b"1]"),
    "numbered words": _deflated(b"[" + b",".join(b'"%030d"' % (k * k) for k in range(_VALUES)) + b"]"),
    "words and numbers": _deflated(b"[" + b",".join(b'"%06d",%d.5' % (k, k) for k in range(14_900)) + b"]"),
    "one text": _deflated(b'"' + _text(_ALL) + b'"'),
    "half a text": _deflated(b'"' + _text(_ALL // 2) + b'"'),
    "a text with one wide letter": _deflated(b'"' + _text(_ALL) + "\U0001f600".encode() + b'"'),
    "a text with one escape": _deflated(b'"' + _text(_ALL) + b'\\ud83d\\ude00"'),
    "a text with escaped quotes": _deflated(b'"\\"' + _text(_ALL) + b'\\ud83d\\ude00"'),
    "a short text with one escape": _deflated(b'"' + _text(240_000) + b'\\ud83d\\ude00"'),
    "json text with one escape": ("json", _json(b'"' + _text(260_000) + b'\\ud83d\\ude00"')),
    "json long numbers": ("json", _json(b"[" + b"17976931348623157081e289," * 10_000 + b"1]")),
    "json long numbers that may be": ("json", _json(b"[" + b"17976931348623157081e289," * 390 + b"1]")),
    "empty blocks": ("zlib", b"\x78\x9c" + _EMPTY_BLOCKS * 52_000),
    "few empty blocks": ("zlib", b"\x78\x9c" + _EMPTY_BLOCKS * 1_600),
    "bomb": ("zlib", zlib.compress(b"[" * 50_000_000, 9)),
}  # fmt: skip
"""The expensive messages: codec and bytes by name; "that may be" marks messages within every limit."""


def _maps() -> list[bytes]:
    bare = encode_map(MapVersion(keyframes=(), provenance={"made_by": "fuzz", "list": [1, [2.5, None]]}))
    whole = encode_map(make_world(7, points=300).walk("robot-1", np.linspace(0.0, 0.1, 3), seed=2)[0])
    few = decode_map(whole).keyframes[:2]
    cut = [replace(k, pixels=k.pixels[:2], descriptors=k.descriptors[:2], points_camera=k.points_camera[:2])
           for k in few]  # fmt: skip
    edge = Edge(a=cut[0].id, b=cut[1].id, T_a_b=np.eye(4), information=np.eye(6))
    cloud = np.ones((2, 3), dtype=np.float32)
    small = encode_map(
        MapVersion(keyframes=tuple(cut), edges=(edge,), points=cloud, colours=cloud.astype(np.uint8))
    )
    return [
        each
        for data in (bare, small, whole)
        for each in (b"\x01" + data, b"\x00" + zlib.decompress(data[8:]))
    ]


def _keyframes() -> list[bytes]:
    keyframe = make_world(7, points=300).walk("robot-1", np.linspace(0.0, 0.1, 3), seed=2)[0].keyframes[0]
    features = keyframe.pixels.tobytes() + keyframe.descriptors.tobytes() + keyframe.points_camera.tobytes()
    heads = (b"\x28\x00\x50\x30\x00", b"\x3f\x00\xd0\x30\x01", b"\x00\x00\x00\x00\x01")
    return [head + b"\0\0\0" + features for head in heads]


def _sandbox_messages() -> list[bytes]:
    answers: tuple[Any, ...] = (
        ["ready"], [True, {"count": 1, "list": [1.5] * 40}, b"state", 1.5], [True, np.arange(8.0), None, 0.1],
        [False, "bad-request", "a problem", "a hint", 2.0], [True, None, None, math.nan], [True, 1, 7, 1.0],
        [True, [["a", 1]] * 30, None, 1.0],
    )  # fmt: skip
    frames = [encode_message(answer) for answer in answers]
    return [b"\x01" + b"".join(frames), *(b"\x00" + frame[4:] for frame in frames)]


def _graphs() -> list[bytes]:
    sphere, _ = make_sphere(1, rings=4, per_ring=5)
    text = write_g2o(sphere).encode()
    lines = text.splitlines(keepends=True)
    return [text, b"".join(lines[:2] + lines[20:21]), b"# nothing\n", b"FIX 0\n" + b"".join(lines[:6])]


def _clouds() -> list[bytes]:
    room = make_room(3, points=150)
    head = b"\x64\x01\x00\x04\x04\x3c\x80\x08\x10\x01\x01"
    return [
        bytes([kind]) + head + room.astype(form).tobytes()
        for kind, form in ((0, "<f8"), (3, "<f4"), (1, "i1"))
    ]


def _views() -> list[bytes]:
    rng = np.random.default_rng(2)
    points = rng.normal(size=300).astype("<f8").tobytes()
    return [
        head + bits + points
        for head in (bytes([40, 40, 0, 100, 40, 0, 9, 9]), bytes([9, 47, 1, 127, 255, 1, 3, 8]))
        for bits in (rng.bytes(256), bytes(256))
    ] + [bytes([0, 0, 0, 255, 0, 0, 0, 0])]


def _depths() -> list[bytes]:
    views = make_two_views(seed=1, n=40, outlier_ratio=0.0)
    numbers = (views.T_camera_reference, views.points_reference, views.pixels, views.depths_m)
    whole = b"".join(np.asarray(each, dtype="<f8").tobytes() for each in numbers)
    return [bytes([40, inliers, kind, 12, 120, 16, misaligned, 0]) + whole
            for inliers in (40, 33, 0) for kind, misaligned in ((0, 0), (1, 1), (9, 0), (8, 1))]  # fmt: skip


def _pictures() -> list[bytes]:
    noise = np.random.default_rng(4).bytes(3000)
    return [bytes([height, width, rows, 51, levels, kind, misaligned, 0]) + noise
            for height, width, rows, levels, kind, misaligned in (
                (160, 170, 12, 8, 5, 0), (170, 150, 30, 4, 6, 1), (45, 45, 1, 1, 5, 0), (1, 0, 5, 8, 1, 0),
                (120, 90, 6, 3, 0, 1), (100, 33, 0, 8, 4, 0))]  # fmt: skip


def _tracks() -> list[bytes]:
    rng = np.random.default_rng(6)
    spots = rng.uniform(0.0, 90.0, 400).astype("<f8").tobytes()
    return [bytes([m, n, kind, 48, radius, 200, misaligned, flipped]) + body
            for m, n, kind, radius, misaligned, flipped in (
                (40, 40, 8, 60, 0, 60), (9, 47, 3 | 32 | 64, 140, 1, 255), (47, 47, 1 | 8 | 128, 30, 0, 1),
                (47, 30, 2 | 128, 252, 1, 80), (0, 0, 0, 0, 0, 0), (30, 1, 16 | 32 | 64, 90, 0, 30))
            for body in (spots, rng.bytes(700))]  # fmt: skip


def _pairs() -> list[bytes]:
    rng = np.random.default_rng(8)
    noise = rng.bytes(40 * 96)
    return [bytes([height, width, rows, most, shift, limits, misaligned, 1]) + body
            for height, width, rows, most, shift, limits, misaligned in (
                (40, 96, 30, 20, 5, 9, 0), (30, 200, 12, 255, 17, 0, 1), (13, 13, 4, 1, 0, 3, 0),
                (1, 90, 5, 9, 1, 1, 0), (40, 30, 0, 8, 2, 255, 1), (60, 90, 40, 60, 30, 251, 0))
            for body in (noise, bytes(200), rng.bytes(90))]  # fmt: skip


def _live_keyframes() -> list[bytes]:
    version, _ = make_world(7, points=1500).walk("robot-1", np.linspace(0.0, 0.05, 2), seed=2)
    coded = [encode_keyframe(SentKeyframe.from_map(keyframe)) for keyframe in version.keyframes]
    return [head + data[skipped:] for data in coded for head, skipped in ((b"\x00", 0), (b"\x05", 162))]


# Functions that make the initial inputs, by name of the target.
_MADE = {
    "codec": _messages, "frames": _frames, "stream": _streams, "geometry": _problems, "maps": _maps,
    "keyframes": _keyframes, "snapshots": _sandbox_messages, "graph": _graphs, "cloud": _clouds,
    "match": _views, "depth": _depths, "describe": _pictures, "track": _tracks,
    "stereo": _pairs,
    "live": _live_keyframes,
}  # fmt: skip
