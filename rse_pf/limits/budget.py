"""Check untrusted bytes before they are decoded: size, inflated size, nesting, number of values, and memory.

Each decoder of the platform calls these checks first; they raise LimitExceeded or BadMessage.  The limits of
one kind of input are a `Budget`.  The checks do not decode: bytes that pass may still be malformed, which the
decoder reports.

Source:
    MessagePack specification, https://github.com/msgpack/msgpack/blob/master/spec.md, "Formats".
"""

from __future__ import annotations

import itertools
import re
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded

__all__ = [
    "LIST_VALUES",
    "MAP_VALUES",
    "PROVENANCE",
    "SERVICE_REPLY",
    "Budget",
    "announced_values",
    "check_json",
    "check_json_containers",
    "check_json_counts",
    "check_msgpack",
    "check_size",
    "inflate_short",
    "inflate_up_to",
    "inflate_within",
    "measure_msgpack",
    "small_text",
]

Text = bytes | bytearray
_Text = TypeVar("_Text", bytes, bytearray, Text)

MESSAGE_INFLATE_RATIO = 100.0
"""Inflated size over wire size of a robot's message."""
MESSAGE_DEPTH = 16
"""Levels of nesting of a robot's message."""
MESSAGE_CONTAINERS = 7000
"""Lists and maps of a robot's message, at any depth."""
MESSAGE_VALUES = 31_000
"""Values of a robot's message outside of raw arrays.  The largest request of ``pnp``, 5,000 correspondences
with their depths in JSON, has 30,000 numbers and less than 100 other values."""
MESSAGE_MEMORY_BYTES = 2_000_000
"""Estimated memory of a decoded JSON message."""
LIST_VALUES = 3
"""How many values a list counts as, by the memory that it takes."""
MAP_VALUES = 6
"""How many values a map counts as, by the memory that it takes."""

_PIECE_BYTES = 32768  # a text is inflated and read in pieces of this size, which fit into the cache of a core
_FLAT_FROM = 32  # a shorter list is read value by value, which then takes less time than a test of the whole
_NOT_BRACKETS_OR_QUOTES = bytes(set(range(256)) - set(b'[]{}"'))

_NOT_BACKSLASH = re.compile(rb"[^\\]")

_SHORT_BYTES = 8192  # no JSON text up to this size exceeds a limit of a message but the depth
_STRING_BYTES = 60  # memory of a string in addition to its characters
_NUMBER_BYTES = 32  # memory of a number in a list
_MAX_CHARACTER_BYTES = 7  # memory of one character of a text that is not ASCII
# msgspec takes up to 10 us for a number of more than 19 significant digits, up to 45 us for one at the ends
# of the range of float64, and less than 0.1 us for any other.
_MAX_LONG_NUMBERS = 400  # of a JSON text, which are read in 4 ms
_MAX_EXTREME_NUMBERS = 200
_EXTREME_NUMBER = re.compile(rb"[0-9][eE][+-]?0*[0-9]{3}")
_LONG_RUN = b"0" * 20  # what a long number contains after `_ZEROS`
_LONG_NUMBER = re.compile(b" 0*1[01]{19}")  # after `_ONES`, without its point
_ZEROS = bytes(ord("0") if k in b"0123456789." else ord(" ") for k in range(256))
_ONES = bytes(ord("0") if k == ord("0") else ord("1") if k in b"123456789" else ord(" ") for k in range(256))


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """The limits of one kind of input.

    Attributes:
        wire_bytes: Size as received.
        inflated_bytes: Size after inflating.
        inflate_ratio: Inflated size over wire size, where the inflated size is above `free_bytes`.
        free_bytes: Inflated size that is allowed at any ratio.
        depth: Levels of nesting; a list of numbers has one.
        containers: Lists and maps, at any depth.
        values: Values outside of raw arrays; a list counts as `LIST_VALUES`, a map as `MAP_VALUES`, and a
            long text or a raw array as two.
        mixed_values: MessagePack only: those of the values that are not in a flat list of numbers of one
            kind, and therefore have to be read one by one.
        memory_bytes: JSON only: estimated memory of the decoded objects.
    """

    wire_bytes: int
    inflated_bytes: int
    inflate_ratio: float
    free_bytes: int
    depth: int
    containers: int
    values: int
    mixed_values: int
    memory_bytes: int

    @classmethod
    def of_messages(cls, session: SessionSettings) -> Budget:
        """Return the budget of a robot's message, also in an event of the Lambda."""
        return cls(
            wire_bytes=session.max_message_bytes, inflated_bytes=session.max_inflated_bytes,
            inflate_ratio=MESSAGE_INFLATE_RATIO, free_bytes=session.max_message_bytes,
            depth=MESSAGE_DEPTH, containers=MESSAGE_CONTAINERS, values=MESSAGE_VALUES,
            mixed_values=MESSAGE_VALUES, memory_bytes=MESSAGE_MEMORY_BYTES,
        )  # fmt: skip


def _plain_budget(*, size: int, depth: int, containers: int, values: int, mixed_values: int) -> Budget:
    """Return the budget of bytes that are not deflated."""
    return Budget(
        wire_bytes=size, inflated_bytes=size, inflate_ratio=1.0, free_bytes=size, depth=depth,
        containers=containers, values=values, mixed_values=mixed_values, memory_bytes=size,
    )  # fmt: skip


PROVENANCE = _plain_budget(size=1 << 20, depth=64, containers=40_000, values=150_000, mixed_values=150_000)
"""Where a map comes from, as its author wrote it."""

SERVICE_REPLY = _plain_budget(size=1 << 26, depth=32, containers=7000, values=150_000, mixed_values=30_000)
"""What an installed service answers, with its snapshot; the size is that of the channel."""


# --- size and inflating ---------------------------------------------------------------------------


def check_size(data: bytes, budget: Budget) -> None:
    """Raise LimitExceeded if *data* is longer on the wire than *budget* allows."""
    if len(data) > budget.wire_bytes:
        raise LimitExceeded(
            f"a message of {len(data)} bytes is above {budget.wire_bytes}",
            hint="send large data to the data server and name it by digest",
        )


def inflate_within(data: bytes, budget: Budget) -> Text:
    """Return the inflated bytes of the zlib stream *data*.

    Raises:
        LimitExceeded: It is longer than *budget* allows; no more than that was inflated.
        BadMessage: It is not one complete zlib stream.
    """
    # The ratio limits large results only: a text of an allowed size is accepted at any ratio.
    plain = budget.free_bytes
    max_bytes = min(budget.inflated_bytes, max(plain, int(len(data) * budget.inflate_ratio)))
    first = int(plain / budget.inflate_ratio)
    stream = zlib.decompressobj()
    try:
        # A decompression bomb is detected here, at a quarter of the cost of inflating all that is allowed.
        head = stream.decompress(data[:first], min(plain, max_bytes) + 1)
        if len(head) > min(plain, max_bytes):
            raise _bomb_error(len(data), min(plain, max_bytes))
        text: Text = head
        if len(data) > first:
            text = _inflate_rest(stream, head, data, first, max_bytes)
    except zlib.error as error:
        raise _not_zlib_error() from error
    return _whole(text, stream, len(data), max_bytes)


def inflate_short(data: bytes, budget: Budget, library: ModuleType) -> bytes:
    """Return the inflated bytes of the short zlib stream *data*.

    Args:
        data: One zlib stream of a few kB.
        budget: The limits.
        library: ``zlib``, or ``isal.isal_zlib``.

    Raises:
        LimitExceeded: It is longer than *budget* allows; no more than that was inflated.
        BadMessage: It is not one complete zlib stream.
    """
    plain_bytes = min(budget.free_bytes, budget.inflated_bytes)
    max_bytes = min(budget.inflated_bytes, max(plain_bytes, int(len(data) * budget.inflate_ratio)))
    text, stream = _inflated(data, plain_bytes + 1, library)
    if len(text) > plain_bytes:
        # Up to plain_bytes any ratio is allowed.  A bomb inflates to more than that from its first bytes, so
        # the ratio is that of the bytes used so far, without those that follow.
        used_bytes = len(data) - len(stream.unconsumed_tail)
        if used_bytes * budget.inflate_ratio <= plain_bytes:
            raise _bomb_error(len(data), plain_bytes)
        try:
            text += stream.decompress(stream.unconsumed_tail, max_bytes + 1 - plain_bytes)
        except library.error as error:
            raise _not_zlib_error() from error
    return _whole(text, stream, len(data), max_bytes)


def inflate_up_to(data: bytes, max_bytes: int, library: ModuleType = zlib) -> bytes | None:
    """Return the inflated bytes of the zlib stream *data*, None if they are more than *max_bytes*.

    Raises:
        BadMessage: It is not one complete zlib stream.
    """
    text, stream = _inflated(data, max_bytes + 1, library)
    return None if len(text) > max_bytes else _whole(text, stream, len(data), max_bytes)


def _inflated(data: bytes, max_bytes: int, library: ModuleType) -> tuple[bytes, Any]:
    """Return the first *max_bytes* that *data* inflates to, and the stream that inflated them."""
    stream = library.decompressobj()
    try:
        return stream.decompress(data, max_bytes), stream
    except library.error as error:
        raise _not_zlib_error() from error


def _whole(text: _Text, stream: Any, size: int, max_bytes: int) -> _Text:
    """Return *text*, which *stream* inflated from *size* bytes, if it is complete and not too long."""
    if len(text) > max_bytes:
        raise _bomb_error(size, max_bytes)
    if not stream.eof or stream.unused_data:
        raise _not_one_stream_error()
    return text


def _inflate_rest(stream: Any, head: bytes, data: bytes, first: int, max_bytes: int) -> bytearray:
    """Inflate *data* from *first* piece by piece, because zlib would hold the text twice otherwise."""
    text = bytearray(head)
    piece = stream.unconsumed_tail
    while len(text) <= max_bytes and not stream.eof:
        if not piece:
            if first >= len(data):
                break
            piece, first = data[first : first + _PIECE_BYTES], first + _PIECE_BYTES
        text += stream.decompress(piece, min(_PIECE_BYTES, max_bytes + 1 - len(text)))
        piece = stream.unconsumed_tail
    if stream.eof and first < len(data):
        raise _not_one_stream_error()
    return text


def _not_zlib_error() -> BadMessage:
    return BadMessage(
        "the message is not a zlib stream", hint="send what the agreed sub-protocol of the WebSocket says"
    )


def _not_one_stream_error() -> BadMessage:
    return BadMessage(
        "the zlib stream does not end with the message", hint="send one zlib stream in each message"
    )


def _bomb_error(size: int, max_bytes: int) -> LimitExceeded:
    return LimitExceeded(f"{size} bytes inflate to more than {max_bytes}", hint="send smaller messages")


# --- MessagePack ----------------------------------------------------------------------------------


def check_msgpack(data: Text, budget: Budget) -> bool:
    """Check the counts and the depth of the one MessagePack value that *data* holds.

    Returns:
        Whether *data* was read.  A message too short to exceed a count is not, because reading it takes as
        long as decoding it, and the decoder refuses deep nesting by itself.

    Raises:
        LimitExceeded: It holds more values, lists or levels than *budget* allows.
        BadMessage: It ends within a value, or bytes follow it.
    """
    end = len(data)
    if end <= budget.containers and end * MAP_VALUES <= budget.mixed_values:
        return False
    if measure_msgpack(data, 0, budget) != end:
        raise BadMessage("bytes follow the message", hint="send one value in each message")
    return True


def measure_msgpack(data: Text, at: int, budget: Budget) -> int:
    """Return where the MessagePack value that begins at byte *at* ends, within *budget*.

    Raises:
        LimitExceeded: It holds more values, lists or levels than *budget* allows.
        BadMessage: *data* ends within it.
    """
    end, steps, limit = len(data), _STEPS, budget.mixed_values
    values = containers = 0
    outer: list[int] = []  # of each list or map that is open: how many values follow this one in it
    values_left = 1
    while True:
        while values_left:
            if at >= end:
                raise _cut_off_error()
            first = data[at]
            step = steps[first]
            values_left -= 1
            values += 1
            if step > 0:
                at += step
            elif step < 0:
                is_map = first < 0x90 or first >= 0xDE
                count = first & 15 if step == -1 else int.from_bytes(data[at + 1 : at - step], "big")
                at -= step
                containers += 1
                values += _MORE[first]
                if count > end - at:  # each value takes a byte
                    raise _cut_off_error()
                if count >= _FLAT_FROM and not is_map and (flat := _flat_bytes(data, at, count)):
                    at += flat
                    values += count
                    limit = min(budget.values, limit + count)
                    count = 0
                if count:
                    outer.append(values_left)
                    values_left = 2 * count if is_map else count
                if len(outer) >= budget.depth or containers > budget.containers:
                    _check_containers(len(outer) + (not count), containers, budget)
            else:
                width, head = _LENGTHS[first]
                values += 1
                at += head + int.from_bytes(data[at + 1 : at + 1 + width], "big")
            if values > limit:
                raise _too_many_values_error(limit)
        if not outer:
            break
        values_left = outer.pop()
    if at > end:
        raise _cut_off_error()
    return at


def announced_values(data: Text, at: int) -> int:
    """Return how many values the list or map at byte *at* announces, two for each key; 0 for other values.

    Raises:
        BadMessage: *data* ends before.
    """
    if at >= len(data):
        raise _cut_off_error()
    first = data[at]
    step = _STEPS[first]
    if step >= 0:
        return 0
    count = first & 15 if step == -1 else int.from_bytes(data[at + 1 : at - step], "big")
    return 2 * count if first < 0x90 or first >= 0xDE else count


def small_text(data: Text, at: int) -> tuple[str, int]:
    """Return the text of at most 31 bytes at byte *at*, such as the name of a field, and where it ends.

    Raises:
        BadMessage: There is something else.
    """
    if at >= len(data) or not 0xA0 <= data[at] < 0xC0:
        raise BadMessage("the name of a field is not a short text", hint="send whole messages")
    end = at + 1 + (data[at] & 31)
    return data[at + 1 : end].decode("ascii", "replace"), end


def _check_containers(depth: int, containers: int, budget: Budget) -> None:
    if containers > budget.containers:
        raise LimitExceeded(f"more than {budget.containers} lists and maps", hint="send raw arrays")
    if depth > budget.depth:
        raise LimitExceeded(f"a message is nested deeper than {budget.depth}", hint="send flat lists")


def _flat_bytes(data: Text, at: int, count: int) -> int:
    """Return the size of *count* numbers of one kind at byte *at*; 0 if there is something else."""
    first = data[at]
    step = _STEPS[first]
    if first < 0x80:
        return count if data[at : at + count].isascii() else 0
    if step <= 0 or 0xA0 <= first < 0xC0 or at + step * count > len(data):
        return 0
    return step * count if data[at : at + step * count : step] == bytes([first]) * count else 0


def _steps() -> tuple[int, ...]:
    """Return the distance to the next value by first byte; 0: see `_LENGTHS`; negative: a list or map."""
    steps = [1] * 256
    steps[0x80:0xA0] = [-1] * 32
    steps[0xA0:0xC0] = [1 + length for length in range(32)]
    fixed = {
        0xCA: 5, 0xCB: 9, 0xCC: 2, 0xCD: 3, 0xCE: 5, 0xCF: 9, 0xD0: 2, 0xD1: 3, 0xD2: 5, 0xD3: 9, 0xD4: 3,
        0xD5: 4, 0xD6: 6, 0xD7: 10, 0xD8: 18, 0xDC: -3, 0xDD: -5, 0xDE: -3, 0xDF: -5,
    }  # fmt: skip
    for first, step in fixed.items():
        steps[first] = step
    for first in _LENGTHS:
        steps[first] = 0
    return tuple(steps)


# By first byte of bin, ext and str: bytes of the length field, and bytes before the content.
_LENGTHS = {
    0xC4: (1, 2), 0xC5: (2, 3), 0xC6: (4, 5), 0xC7: (1, 3), 0xC8: (2, 4), 0xC9: (4, 6), 0xD9: (1, 2),
    0xDA: (2, 3), 0xDB: (4, 5),
}  # fmt: skip

_STEPS = _steps()
_MORE = tuple((MAP_VALUES if k < 0x90 or k >= 0xDE else LIST_VALUES) - 1 for k in range(256))


def _cut_off_error() -> BadMessage:
    return BadMessage("the message ends within a value", hint="send whole messages")


def _too_many_values_error(max_values: int) -> LimitExceeded:
    return LimitExceeded(
        f"more than {max_values} values in one message",
        hint="send large data to the data server, and numbers of at most 19 digits",
    )


# --- JSON -----------------------------------------------------------------------------------------


def check_json(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more lists, levels, values or memory than *budget* allows."""
    check_json_containers(text, budget)
    check_json_counts(text, budget)


def check_json_containers(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more lists and objects, or levels of them, than *budget* allows.

    Brackets inside strings do not count; a text with many brackets is read once more to exclude them.
    """
    max_depth = budget.depth
    max_lists = budget.containers
    count = text.count(b"[") + text.count(b"{")
    if count <= max_depth:
        return
    brackets = b"".join(_without_strings(text, _NOT_BRACKETS_OR_QUOTES))
    if brackets.count(b"[") + brackets.count(b"{") > max_lists:
        raise LimitExceeded(
            f"JSON of more than {max_lists} lists and objects", hint="send flat lists of numbers"
        )
    if _depth(brackets) > max_depth:
        raise LimitExceeded(f"JSON is nested deeper than {max_depth}", hint="send flat lists")


def check_json_counts(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more values, long numbers or memory than *budget* allows.

    Commas, colons and brackets inside strings count, too, unless only they exceed a limit.
    """
    if text.count(b"e") + text.count(b"E") > _MAX_EXTREME_NUMBERS:
        _check_exponents(text)
    if len(text) <= _SHORT_BYTES:
        return
    pieces = (text[at : at + _PIECE_BYTES] for at in range(0, len(text), _PIECE_BYTES))
    try:
        _check_pieces(text, pieces, budget, has_strings=True)
    except LimitExceeded:
        _check_pieces(text, _without_strings(text, b""), budget, has_strings=False)


def _check_exponents(text: Text) -> None:
    numbers = _EXTREME_NUMBER.finditer(text)
    if sum(1 for _ in itertools.islice(numbers, _MAX_EXTREME_NUMBERS + 1)) > _MAX_EXTREME_NUMBERS:
        raise LimitExceeded(
            f"more than {_MAX_EXTREME_NUMBERS} numbers have an exponent of three digits",
            hint="send zero for numbers that are nearly zero",
        )


def _check_pieces(text: Text, pieces: Iterable[Text], budget: Budget, *, has_strings: bool) -> None:
    """Raise LimitExceeded if *text* exceeds a limit by what its *pieces* hold.

    With *has_strings* the pieces still hold the strings, whose length is unknown, so all characters count.
    """
    marks = containers = long_numbers = outside = 0
    for piece in pieces:
        outside += len(piece)
        marks += piece.count(b",") + piece.count(b":")
        containers += LIST_VALUES * piece.count(b"[") + MAP_VALUES * piece.count(b"{")
        if _LONG_RUN in piece.translate(_ZEROS):
            long_numbers += sum(1 for _ in _LONG_NUMBER.finditer(piece.translate(_ONES, b".")))
    if marks + containers >= budget.values:
        raise _too_many_values_error(budget.values)
    if long_numbers > _MAX_LONG_NUMBERS:
        raise LimitExceeded(
            f"more than {_MAX_LONG_NUMBERS} numbers have more than 19 significant digits",
            hint="round the numbers before sending",
        )
    strings = text.count(b'"') // 2
    characters = len(text) if has_strings else len(text) - outside
    memory = _STRING_BYTES * strings + _NUMBER_BYTES * max(0, marks - strings) + len(text)
    memory += characters if text.isascii() and b"\\u" not in text else _MAX_CHARACTER_BYTES * characters
    if memory > budget.memory_bytes:
        raise LimitExceeded(
            f"a message that would take more than {budget.memory_bytes} bytes of memory",
            hint="send arrays of numbers, or large data to the data server",
        )


def _depth(brackets: Text) -> int:
    opening = np.isin(np.frombuffer(brackets, np.uint8), np.frombuffer(b"[{", np.uint8))
    return int(np.cumsum(np.where(opening, np.int8(1), np.int8(-1)), dtype=np.int32).max(initial=0))


def _without_strings(text: Text, dropped: bytes) -> Iterator[bytes]:
    """Yield *text* in pieces, without its strings and the bytes *dropped*."""
    is_inside = False
    end = 0
    while end < len(text):
        begin, end = end, end + _PIECE_BYTES
        if text[end - 1 : end] == b"\\":  # a backslash and what it escapes are in one piece
            end = len(text) if (after := _NOT_BACKSLASH.search(text, end)) is None else after.end()
        marks = text[begin:end].replace(b"\\\\", b"  ").replace(b'\\"', b"  ").translate(None, dropped)
        signs: npt.NDArray[np.uint8] = np.frombuffer(marks, np.uint8)
        quotes = signs == ord('"')
        inside = np.logical_xor.accumulate(quotes) ^ is_inside
        yield signs[~(inside | quotes)].tobytes()
        is_inside = bool(inside[-1]) if len(inside) else is_inside
