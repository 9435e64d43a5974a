"""A mutation fuzzer without coverage: where atheris has no wheel, and in the tests, where runs must be equal.

Promises that equal seeds and samples give equal inputs, on every machine.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence

__all__ = ["mutations"]

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
_INTERESTING = (0, 1, 15, 16, 31, 32, 63, 64, 125, 126, 127, 128, 129, 191, 192, 220, 221, 254, 255)


def mutations(samples: Sequence[bytes], *, seed: int, longest: int) -> Iterator[bytes]:
    """Yield the *samples*, and then damaged copies of them for ever, at most *longest* bytes each."""
    yield from samples
    rng = random.Random(seed)
    while True:
        # Mostly of the shorter: a dear message takes the time of a thousand small ones.
        data = bytearray(min((rng.choice(samples) for _ in range(3)), key=len))
        for _ in range(1 + min(rng.getrandbits(3), rng.getrandbits(3))):
            rng.choice(_CHANGES)(rng, data, samples)
        yield bytes(data[:longest])


def _flip(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice(_INTERESTING)


def _insert(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.choice(_TOKENS)


def _overwrite(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    token = rng.choice(_TOKENS)
    at = rng.randint(0, len(data))
    data[at : at + len(token)] = token


def _cut(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    start, end = _range(rng, data)
    del data[start:end]


def _double(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    start, end = _range(rng, data)
    data[end:end] = data[start:end] * (1 << rng.randrange(rng.choice((2, 5, 17))))


def _splice(rng: random.Random, data: bytearray, samples: Sequence[bytes]) -> None:
    other = min(rng.choice(samples), rng.choice(samples), key=len)
    if other and data:
        data[rng.randrange(len(data)) :] = other[rng.randrange(len(other)) :]


def _range(rng: random.Random, data: bytearray) -> tuple[int, int]:
    start = rng.randint(0, len(data))
    return start, min(len(data), start + rng.choice((1, 1, 2, 4, 9, 16, 64)))


_CHANGES: tuple[Callable[[random.Random, bytearray, Sequence[bytes]], None], ...] = (
    _flip, _set, _insert, _overwrite, _cut, _double, _splice,
)  # fmt: skip
