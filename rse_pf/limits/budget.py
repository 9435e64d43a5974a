"""Check untrusted bytes before they are decoded: size, inflated size, nesting, number of values, and memory.

Each decoder of the platform calls these checks before it decodes; they raise LimitExceeded or BadMessage.  A
`Budget` holds the limits of one kind of input.  The checks do not decode: bytes that pass them may still be
malformed, which the decoder reports.

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
"""Largest quotient of the inflated size and the transmitted size of a robot's message, where the inflated
size is above ``session.max_message_bytes``."""
MESSAGE_DEPTH = 16
"""Most levels of nesting of a robot's message."""
MESSAGE_CONTAINERS = 7000
"""Most lists and maps of a robot's message, counted at all depths."""
MESSAGE_VALUES = 31_000
"""Most values of a robot's message outside of raw arrays.  The largest request of ``pnp``, 5,000
correspondences with their depths in JSON, has 30,000 numbers and less than 100 other values."""
MESSAGE_MEMORY_BYTES = 2_000_000
"""Most bytes of memory that a robot's message in JSON may take when it is decoded, as estimated."""
LIST_VALUES = 3
"""Number of values that a list counts as, because it takes the memory of so many numbers."""
MAP_VALUES = 6
"""Number of values that a map counts as, because it takes the memory of so many numbers."""

_PIECE_BYTES = 32768  # a text is inflated and read in pieces of this size, which fit into the cache of a core
_FLAT_FROM = 32  # values of a list from which on it is tested as a whole: below, value by value is faster
_NOT_BRACKETS_OR_QUOTES = bytes(set(range(256)) - set(b'[]{}"'))  # all bytes but brackets and quotes

_NOT_BACKSLASH = re.compile(rb"[^\\]")

_SHORT_BYTES = 8192  # a JSON text of up to this size cannot exceed a limit of messages except the depth
_STRING_BYTES = 60  # estimated memory of a decoded string in addition to its characters
_NUMBER_BYTES = 32  # estimated memory of a decoded number in a list
_MAX_CHARACTER_BYTES = 7  # most memory of one byte of a string in a text that is not ASCII or has \u escapes
# msgspec decodes a number of more than 19 significant digits in up to 10 us, a number at the ends of the
# range of float64 in up to 45 us, and any other number in less than 0.1 us.
_MAX_LONG_NUMBERS = 400  # numbers of more than 19 significant digits in a JSON text, decoded in 4 ms
_MAX_EXTREME_NUMBERS = 200  # numbers with an exponent of three digits in a JSON text, decoded in 9 ms
_EXTREME_NUMBER = re.compile(rb"[0-9][eE][+-]?0*[0-9]{3}")  # a number with an exponent of three digits
_LONG_RUN = b"0" * 20  # part of each number with 20 digits, in a text that was translated by `_ZEROS`
_LONG_NUMBER = re.compile(b" 0*1[01]{19}")  # 20 significant digits, in a text translated by `_ONES`
# Translates each digit and the decimal point to 0, and all other bytes to a space.
_ZEROS = bytes(ord("0") if k in b"0123456789." else ord(" ") for k in range(256))
# Translates the digit 0 to 0, each other digit to 1, and all other bytes to a space.
_ONES = bytes(ord("0") if k == ord("0") else ord("1") if k in b"123456789" else ord(" ") for k in range(256))


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """The limits of one kind of input.

    Attributes:
        wire_bytes: Largest size as received.
        inflated_bytes: Largest size after inflating.
        inflate_ratio: Largest quotient of inflated and received size, if the inflated size is above
            ``free_bytes``.
        free_bytes: Inflated size up to which any such quotient is allowed.
        depth: Most levels of nesting; a list of numbers has one level.
        containers: Most lists and maps, counted at all depths.
        values: Most values outside of raw arrays.  A list counts as `LIST_VALUES`, a map as `MAP_VALUES`, and
            a long text or a raw array as two.
        mixed_values: MessagePack only: most values that are not in a flat list of numbers of one type, and
            therefore have to be read one by one.
        memory_bytes: JSON only: largest estimated memory of the decoded values.
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
        """Return the limits of a robot's message, on a WebSocket or in an event of the Lambda function."""
        return cls(
            wire_bytes=session.max_message_bytes, inflated_bytes=session.max_inflated_bytes,
            inflate_ratio=MESSAGE_INFLATE_RATIO, free_bytes=session.max_message_bytes,
            depth=MESSAGE_DEPTH, containers=MESSAGE_CONTAINERS, values=MESSAGE_VALUES,
            mixed_values=MESSAGE_VALUES, memory_bytes=MESSAGE_MEMORY_BYTES,
        )  # fmt: skip


def _plain_budget(*, size: int, depth: int, containers: int, values: int, mixed_values: int) -> Budget:
    """Return the limits of bytes that are not compressed; *size* also limits the memory."""
    return Budget(
        wire_bytes=size, inflated_bytes=size, inflate_ratio=1.0, free_bytes=size, depth=depth,
        containers=containers, values=values, mixed_values=mixed_values, memory_bytes=size,
    )  # fmt: skip


PROVENANCE = _plain_budget(size=1 << 20, depth=64, containers=40_000, values=150_000, mixed_values=150_000)
"""Limits of the provenance of a map: what its author states about where the map comes from."""

SERVICE_REPLY = _plain_budget(size=1 << 26, depth=32, containers=7000, values=150_000, mixed_values=30_000)
"""Limits of the reply of a sandboxed service, with the snapshot of its state."""


# --- checks of the size as received, and inflating within limits ------------------------------------


def check_size(data: bytes, budget: Budget) -> None:
    """Raise LimitExceeded if *data*, as it was received, is longer than ``wire_bytes`` of *budget*."""
    if len(data) > budget.wire_bytes:
        raise LimitExceeded(
            f"a message of {len(data)} bytes is above {budget.wire_bytes}",
            hint="send large data to the data server and name it by digest",
        )


def inflate_within(data: bytes, budget: Budget) -> Text:
    """Return the inflated bytes of the zlib stream *data*.

    Raises:
        LimitExceeded: The result would be longer than *budget* allows; at most one byte more was inflated.
        BadMessage: *data* is not exactly one complete zlib stream.
    """
    # The ratio limits large results only: up to free_bytes any ratio is allowed.
    plain = budget.free_bytes
    max_bytes = min(budget.inflated_bytes, max(plain, int(len(data) * budget.inflate_ratio)))
    first = int(plain / budget.inflate_ratio)
    stream = zlib.decompressobj()
    try:
        # A decompression bomb is detected here, in a quarter of the time of inflating all that is allowed.
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
    """Return the inflated bytes of the short zlib stream *data*, with fewer calls than `inflate_within`.

    Args:
        data: One zlib stream of a few kB.
        budget: The limits.
        library: Module that inflates: ``zlib``, or ``isal.isal_zlib``.

    Raises:
        LimitExceeded: The result would be longer than *budget* allows; at most one byte more was inflated.
        BadMessage: *data* is not exactly one complete zlib stream.
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
    """Return the inflated bytes of the zlib stream *data*, None if there are more than *max_bytes*.

    *library* is the module that inflates: ``zlib`` or ``isal.isal_zlib``.

    Raises:
        BadMessage: *data* is not exactly one complete zlib stream.
    """
    text, stream = _inflated(data, max_bytes + 1, library)
    return None if len(text) > max_bytes else _whole(text, stream, len(data), max_bytes)


def _inflated(data: bytes, max_bytes: int, library: ModuleType) -> tuple[bytes, Any]:
    """Return the first *max_bytes* to which *data* inflates, and the decompression object.

    Raises:
        BadMessage: *data* is not a zlib stream.
    """
    stream = library.decompressobj()
    try:
        return stream.decompress(data, max_bytes), stream
    except library.error as error:
        raise _not_zlib_error() from error


def _whole(text: _Text, stream: Any, size: int, max_bytes: int) -> _Text:
    """Return *text*, which the decompression object *stream* inflated from *size* bytes, if it is complete.

    Raises:
        LimitExceeded: *text* is longer than *max_bytes*.
        BadMessage: The zlib stream is incomplete, or bytes follow it.
    """
    if len(text) > max_bytes:
        raise _bomb_error(size, max_bytes)
    if not stream.eof or stream.unused_data:
        raise _not_one_stream_error()
    return text


def _inflate_rest(stream: Any, head: bytes, data: bytes, first: int, max_bytes: int) -> bytearray:
    """Return *head* and the bytes to which *data* inflates from byte *first* on, up to *max_bytes* + 1.

    *data* is inflated piece by piece, because zlib would otherwise hold the text twice in memory.
    """
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


# --- checks of MessagePack --------------------------------------------------------------------------


def check_msgpack(data: Text, budget: Budget) -> bool:
    """Check the numbers of values and containers and the depth of the MessagePack value *data*.

    Returns:
        Whether *data* was checked.  False for a message that is too short to exceed a number: checking it
        would take as long as decoding it, so the caller checks the depth of the decoded value instead.

    Raises:
        LimitExceeded: *data* holds more values, lists or levels than *budget* allows.
        BadMessage: *data* ends within a value, or bytes follow the value.
    """
    end = len(data)
    if end <= budget.containers and end * MAP_VALUES <= budget.mixed_values:
        return False
    if measure_msgpack(data, 0, budget) != end:
        raise BadMessage("bytes follow the message", hint="send one value in each message")
    return True


def measure_msgpack(data: Text, at: int, budget: Budget) -> int:
    """Return the index of the byte after the MessagePack value that begins at byte *at* of *data*.

    Raises:
        LimitExceeded: The value holds more values, lists or levels than *budget* allows.
        BadMessage: *data* ends within the value.
    """
    end, steps, limit = len(data), _STEPS, budget.mixed_values
    values = containers = 0
    outer: list[int] = []  # for each list or map around the present one: its values that are still to be read
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
    """Return the number of values in the list or map whose head is at byte *at*; 0 for any other value.

    A map has two values for each member: the key and the value.  The values themselves are not read.

    Raises:
        BadMessage: *data* has no byte *at*.
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
    """Return the short MessagePack text at byte *at*, and the index of the byte after it.

    Raises:
        BadMessage: The value at *at* is not a text of at most 31 bytes, or *data* has no byte *at*.
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
    """Return the size in bytes of *count* values of one fixed-size type, such as float64, at byte *at*.

    Returns 0 if the values there have several types or no fixed size, or *data* is too short.
    """
    first = data[at]
    step = _STEPS[first]
    if first < 0x80:
        return count if data[at : at + count].isascii() else 0
    if step <= 0 or 0xA0 <= first < 0xC0 or at + step * count > len(data):
        return 0
    return step * count if data[at : at + step * count : step] == bytes([first]) * count else 0


def _steps() -> tuple[int, ...]:
    """Return a table by the first byte of a MessagePack value.

    An entry is the size in bytes of the value; 0 if the size follows from a length field (`_LENGTHS`); for a
    list or map, the negative size of its head.
    """
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


# By first byte of a bin, ext or str value: the bytes of its length field, and the bytes before its content.
_LENGTHS = {
    0xC4: (1, 2), 0xC5: (2, 3), 0xC6: (4, 5), 0xC7: (1, 3), 0xC8: (2, 4), 0xC9: (4, 6), 0xD9: (1, 2),
    0xDA: (2, 3), 0xDB: (4, 5),
}  # fmt: skip

# By first byte of a MessagePack value: how far the next value is, see `_steps`.
_STEPS = _steps()
# By first byte of a list or map: the number of values that it counts as, less one.
_MORE = tuple((MAP_VALUES if k < 0x90 or k >= 0xDE else LIST_VALUES) - 1 for k in range(256))


def _cut_off_error() -> BadMessage:
    return BadMessage("the message ends within a value", hint="send whole messages")


def _too_many_values_error(max_values: int) -> LimitExceeded:
    return LimitExceeded(
        f"more than {max_values} values in one message",
        hint="send large data to the data server, and numbers of at most 19 digits",
    )


# --- checks of JSON ---------------------------------------------------------------------------------


def check_json(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more lists, levels, values or memory than *budget* allows."""
    check_json_containers(text, budget)
    check_json_counts(text, budget)


def check_json_containers(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* has more lists and objects, or levels of nesting, than *budget* allows.

    Brackets inside strings do not count.
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
    """Raise LimitExceeded if *text* holds too many values or long numbers, or would take too much memory.

    The text is checked with its strings first, which is faster.  If a limit is exceeded, it is checked again
    without them, so that commas, colons and brackets inside strings do not count.
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
    """Raise LimitExceeded if *text* has more than `_MAX_EXTREME_NUMBERS` with exponents of three digits."""
    numbers = _EXTREME_NUMBER.finditer(text)
    if sum(1 for _ in itertools.islice(numbers, _MAX_EXTREME_NUMBERS + 1)) > _MAX_EXTREME_NUMBERS:
        raise LimitExceeded(
            f"more than {_MAX_EXTREME_NUMBERS} numbers have an exponent of three digits",
            hint="send zero for numbers that are nearly zero",
        )


def _check_pieces(text: Text, pieces: Iterable[Text], budget: Budget, *, has_strings: bool) -> None:
    """Raise LimitExceeded if *text*, which is read in *pieces*, exceeds a limit of *budget*.

    With *has_strings* the pieces contain the strings, whose length is therefore unknown: all characters of
    the text count as characters of strings.
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
    """Return the levels of nesting of a text that consists of brackets only."""
    opening = np.isin(np.frombuffer(brackets, np.uint8), np.frombuffer(b"[{", np.uint8))
    return int(np.cumsum(np.where(opening, np.int8(1), np.int8(-1)), dtype=np.int32).max(initial=0))


def _without_strings(text: Text, dropped: bytes) -> Iterator[bytes]:
    """Yield the JSON *text* in pieces, without its strings and without each byte that is in *dropped*."""
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
