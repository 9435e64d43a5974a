"""Damaged inputs from Hypothesis: well-formed samples with bytes replaced, inserted, removed or repeated.

This engine is for machines without atheris and for the tests, whose runs must be equal: the same seed gives
the same inputs.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from fuzz.samples import MAX_INPUT_BYTES, samples

__all__ = ["damaged", "run_damaged"]

# Texts that edits insert: parts of JSON and MessagePack, and boundary values.
_TOKENS = (
    b"[", b"]", b"{", b"}", b'"', b"\\", b"\\u0000", b"\\ud800", b",", b":", b"null", b"true", b"1e308",
    b"-0.0", b"1e999", b"NaN", b"9007199254740992", b"18446744073709551616", b'"type":', b'"command"',
    b'"payload":', b'"hello"', b'"cancel"', b'"id":', b'{"a":', b"[[[[[[[[[[[[[[[[[[", b"9" * 400,
    b"\xef\xbb\xbf", b"\xff",
    b"\xc0\x80", b"\xed\xa0\x80", b"\x00", b"\x90", b"\x80", b"\xc0", b"\xc1", b"\xcb\x7f\xf8\0\0\0\0\0\0",
    b"\xca\x7f\x80\0\0", b"\xdc\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xdd\x00\x03\xff\x00", b"\xde\xff\xff",
    b"\xdf\x7f\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff\x01",
    b"\xc7\x04\x01\0\0\x80\x7f", b"\xc7\x08\x03\0\0\0\0\0\0\xf8\x7f", b"\xd4\x01\x00", b"\xcf" + b"\xff" * 8,
    b"\x88\x02\x03\xe8", b"\x89\x00", b"\x80\x00", b"\x00\x00", b"\x81\xfe\xff\xff", b"\x78\x9c",
    b"\x00\x00\xff\xff",
)  # fmt: skip
# Number of repeats of an insertion by the byte that chooses it; other bytes insert once.
_REPEATS = {255: 65_536, 254: 4096, 253: 256, 252: 64, 251: 16, 250: 4, 249: 2}
_EDIT = struct.Struct("<HBBBB")
"""An edit of a sample: position, number of removed bytes, two bytes that choose the insertion, and
repeats."""


def damaged(target: str) -> st.SearchStrategy[bytes]:
    """Return a strategy for samples of *target* with one to four edits, at most `MAX_INPUT_BYTES` bytes each.

    Each input follows from at most 26 bytes, which Hypothesis draws at once.
    """
    known = sorted(samples(target), key=len)
    parts = [part for data in known[: len(known) // 2 + 1] for part in (data[-64:], data[: len(data) // 2])]
    inserts = (b"", *_TOKENS, *parts)

    def make(drawn: bytes) -> bytes:
        data = known[int.from_bytes(drawn[:2], "little") % len(known)]
        for place, removed, which, value, often in _EDIT.iter_unpack(drawn[2 : 2 + len(drawn[2:]) // 6 * 6]):
            at = place % (len(data) + 1)
            inserted = bytes([value]) if which < 64 else inserts[(which * 256 + value) % len(inserts)]
            data = data[:at] + inserted * _REPEATS.get(often, 1) + data[at + removed % 17 :]
        return data[:MAX_INPUT_BYTES]

    return st.binary(min_size=8, max_size=26).map(make)


def run_damaged(target: str, run: Callable[[bytes], None], *, first: int, inputs: int) -> None:
    """Call *run* with the samples of *target*, then with *inputs* damaged ones of seed *first*.

    Raises:
        Exception: The exception that *run* raised for an input.
    """
    for data in samples(target):
        run(data)

    @seed(first)
    @settings(
        max_examples=inputs,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=damaged(target))
    def each(data: bytes) -> None:
        run(data)

    each()
