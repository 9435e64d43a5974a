"""Judge a stranger's bytes before any object is made from them: size, ratio, depth, counts and memory.

Every decoder of the platform asks here first: bytes go in, and nothing or a typed error comes out.  The
limits of one kind of input are a `Budget`.  Nothing here decodes: what passes may still be malformed, which
the decoder reports.

Source:
    MessagePack specification, https://github.com/msgpack/msgpack/blob/master/spec.md, "Formats".
"""

from __future__ import annotations

import itertools
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded, RsePfError

__all__ = [
    "LIST_VALUES",
    "MAP_VALUES",
    "PROVENANCE",
    "SERVICE_REPLY",
    "Budget",
    "Refusal",
    "announced_values",
    "check_json",
    "check_json_containers",
    "check_msgpack",
    "check_size",
    "inflate_short",
    "inflate_within",
    "measure_msgpack",
    "refusal",
    "small_text",
]

Text = bytes | bytearray

MESSAGE_INFLATE_RATIO = 100.0
"""Inflated size over wire size of a robot's message."""
MESSAGE_DEPTH = 16
"""Levels of nesting of a robot's message."""
MESSAGE_CONTAINERS = 7000
"""Lists and maps of a robot's message, at any depth."""
MESSAGE_VALUES = 30_000
"""Values of a robot's message outside of raw arrays.  The largest request of ``pnp``, 5,000 correspondences
in JSON, has less than all of them; 2,000 correspondences need less than half."""
MESSAGE_MEMORY_BYTES = 2_000_000
"""Estimated memory of a decoded JSON message."""
LIST_VALUES, MAP_VALUES = 3, 6
"""How many values a list and a map count as, according to the memory that they take."""

_PIECE_BYTES = 32768
# Bytes in memory per string, per number, per character of a text beyond ASCII, and per byte at worst.
_STRING_BYTES, _NUMBER_BYTES, _WIDE, _MAX_BYTES_PER_BYTE = 60, 32, 7, 8
_FEW_STRINGS = 2000
_FLAT_FROM = 32
"""Shorter lists are read value by value."""
_NOT_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
_NOT_BRACKETS_OR_QUOTES = bytes(set(range(256)) - set(b'[]{}"'))
_NOT_MARKS_OR_QUOTES = bytes(set(range(256)) - set(b',:[]{}"'))
# A number counts as more than one value if decoders need longer for it: because it has many digits, lies in
# the middle between two doubles, or is about as small or large as a double can be.
_LONG_DIGITS = 19
"""Significant digits from which a number counts as one more value for every two of its digits."""
_WIDE_DIGITS = 32
"""Digits, leading zeros included, from which a number counts as long, too."""
_MIDDLE_DIGITS = 16
"""Significant digits from which a number can lie in the middle between two doubles."""
_MIDDLE_WHOLE_DIGITS = 12
"""A number below `_LONG_DIGITS` with fewer digits before its point is never such a middle."""
_MIDDLE_POWER = -4
"""Power of ten of the last digit from which a number can be such a middle."""
_MIDDLE_VALUES = 10
"""Values that a possible middle counts as, beyond its own."""
_FAR_VALUES = 160
"""Values that a number counts as, beyond its own, if it is about as small or large as a double can be."""
_MOST_VALUES_PER_BYTE = 40
"""Upper bound of the values that the numbers of a text count as, for each byte of the text."""
_EXPONENT_DIGITS = 9
"""Longest exponent that is read as a number; a longer one counts as `_MOST_EXPONENT`."""
_MOST_EXPONENT = 10**9
_COSTLY_EXPONENT = re.compile(rb"e(?<=[0-9.]e)(?:[+-]?0*([1-9][0-9]{2})|\+?0*[2-9][0-9](?![0-9]))")
_MANY_DIGITS = re.compile(rb"([0-9.]{16,})(?=(?:e([+-]?)([0-9]+))?)")
_DIGITS = bytes(ord("0") if k in b"0123456789." else ord(" ") for k in range(256))
_MARKS_OF_NUMBERS = bytes(
    k if k in b"0123456789.e+-" else ord("e" if k == ord("E") else " ") for k in range(256)
)


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
            long text or a raw array as two.  In JSON, a number that takes long to read counts as several.
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


Refusal = Literal[
    "json-containers", "json-depth", "containers", "depth", "values", "memory", "cut-off", "followed",
    "not-zlib", "not-one-stream", "bomb", "blocks",
]  # fmt: skip
"""Why bytes are refused."""


def refusal(reason: Refusal, budget: Budget, *, size: int, max_bytes: int) -> RsePfError:
    """Return the error of *reason*, for another implementation of these guards.

    Args:
        reason: What was found.
        budget: The limits.
        size: Bytes on the wire.
        max_bytes: What a bomb inflates to more than.
    """
    errors: dict[Refusal, Callable[[], RsePfError]] = {
        "json-containers": lambda: _too_many_json_containers_error(budget.containers),
        "json-depth": lambda: _too_deep_json_error(budget.depth),
        "containers": lambda: _too_many_containers_error(budget.containers),
        "depth": lambda: _too_deep_error(budget.depth),
        "values": lambda: _too_many_values_error(budget.values),
        "memory": lambda: _too_much_memory_error(budget.memory_bytes),
        "cut-off": _cut_off_error,
        "followed": _trailing_bytes_error,
        "not-zlib": _not_zlib_error,
        "not-one-stream": _not_one_stream_error,
        "bomb": lambda: _bomb_error(size, max_bytes),
        "blocks": _too_many_blocks_error,
    }
    return errors[reason]()


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
    if len(text) > max_bytes:
        raise _bomb_error(len(data), max_bytes)
    if not stream.eof or stream.unused_data:
        raise _not_one_stream_error()
    return text


def inflate_short(data: bytes, max_bytes: int) -> bytes | None:
    """Return the inflated bytes of the zlib stream *data*, None if they are more than *max_bytes*.

    Raises:
        BadMessage: It is not one complete zlib stream.
    """
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(data, max_bytes + 1)
    except zlib.error as error:
        raise _not_zlib_error() from error
    if len(text) > max_bytes:
        return None
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
    return BadMessage("not a zlib stream", hint="is this the sub-protocol that was agreed?")


def _not_one_stream_error() -> BadMessage:
    return BadMessage("the zlib stream does not end with the message", hint="one stream for each message")


def _bomb_error(size: int, max_bytes: int) -> LimitExceeded:
    return LimitExceeded(f"{size} bytes inflate to more than {max_bytes}", hint="send smaller messages")


def _too_many_blocks_error() -> LimitExceeded:
    return LimitExceeded("a zlib stream of many tiny blocks", hint="deflate a message as a whole")


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
        raise _trailing_bytes_error()
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
        raise _too_many_containers_error(budget.containers)
    if depth > budget.depth:
        raise _too_deep_error(budget.depth)


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
        hint="send large data to the data server, and numbers of at most 18 digits",
    )


def _too_many_containers_error(most: int) -> LimitExceeded:
    return LimitExceeded(f"more than {most} lists and maps", hint="send arrays, raw")


def _too_deep_error(most: int) -> LimitExceeded:
    return LimitExceeded(f"a message is nested deeper than {most}", hint="send flat lists")


def _trailing_bytes_error() -> BadMessage:
    return BadMessage("bytes follow the message", hint="one value for each message")


# --- JSON -----------------------------------------------------------------------------------------


def check_json(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more lists, levels, values or memory than *budget* allows."""
    check_json_containers(text, budget)
    _check_values(text, budget.values)
    _check_memory(text, budget.memory_bytes)


def check_json_containers(text: Text, budget: Budget) -> None:
    """Raise LimitExceeded if *text* holds more lists and objects, or levels of them, than *budget* allows.

    Brackets inside strings are told apart only if all brackets together exceed a limit.
    """
    max_depth = budget.depth
    max_lists = budget.containers
    count = text.count(b"[") + text.count(b"{")
    if count <= max_depth:
        return
    if count <= max_lists and _depth(text.translate(None, _NOT_BRACKETS)) <= max_depth:
        return
    brackets = b"".join(_without_strings(text, _NOT_BRACKETS_OR_QUOTES))
    if brackets.count(b"[") + brackets.count(b"{") > max_lists:
        raise _too_many_json_containers_error(max_lists)
    if _depth(brackets) > max_depth:
        raise _too_deep_json_error(max_depth)


def _check_values(text: Text, max_values: int) -> None:
    """Check the number of values before any is created; strings are told apart only above the limit."""
    values_left = max_values - _values(text)
    # Many words may hold many digits: they are told apart at once.
    if values_left > 0 and (
        len(text) * _MOST_VALUES_PER_BYTE < values_left
        or (text.count(b'"') < _FEW_STRINGS and _more_values(_pieces(text), values_left) < values_left)
    ):
        return
    outside = b"".join(_without_strings(text, _NOT_MARKS_OR_QUOTES))
    values_left = max_values - _values(outside)
    numbers = _without_strings(text, b"", is_separated=True)
    if values_left <= 0 or _more_values(numbers, values_left) >= values_left:
        raise _too_many_values_error(max_values)


def _pieces(text: Text) -> Iterator[Text]:
    for begin in range(0, len(text), _PIECE_BYTES):
        yield text[begin : begin + _PIECE_BYTES]


def _more_values(pieces: Iterable[Text], enough: int) -> int:
    """Return for how many more values the numbers in *pieces* of a text count, or at least *enough*.

    Decoders take 0.1 us for most numbers, 0.2 to 1 us for many digits and for the middle between two doubles,
    and up to 14 us near the smallest and the largest double.
    """
    values = 0
    rest = b""
    for piece in itertools.chain(pieces, (b" ",)):
        marks = rest + piece.translate(_MARKS_OF_NUMBERS)
        # What may continue in the next piece is read there.
        cut = marks.rfind(b" ") + 1
        whole, rest = marks[:cut], marks[cut:]
        for exponent in _COSTLY_EXPONENT.finditer(whole):
            values += _FAR_VALUES if exponent[1] else _MIDDLE_VALUES
            if values >= enough:
                return values
        if b"0" * _MIDDLE_DIGITS not in whole.translate(_DIGITS):
            continue
        for token in whole.split():
            if len(token) < _MIDDLE_DIGITS:
                continue
            # Most numbers have fewer digits, or are real ones with many decimals.
            is_short = len(token) < _LONG_DIGITS and b"e" not in token
            if not (is_short and token.find(b".") < _MIDDLE_WHOLE_DIGITS):
                values += sum(map(_values_of_digits, _MANY_DIGITS.finditer(token)))
        if values >= enough:
            break
    return values


def _values_of_digits(digits_and_exponent: re.Match[bytes]) -> int:
    run, sign, exponent = digits_and_exponent.groups()
    number = run.replace(b".", b"")
    digits = len(number)
    significant = len(number.lstrip(b"0"))
    more = digits // 2 if significant >= _LONG_DIGITS or digits >= _WIDE_DIGITS else 0
    decimals = len(run) - 1 - run.find(b".") if digits < len(run) else 0
    if significant < _MIDDLE_DIGITS or (exponent is None and digits == len(run)):
        return more
    exponent = (exponent or b"").lstrip(b"0")
    power = _MOST_EXPONENT if len(exponent) > _EXPONENT_DIGITS else int(exponent or b"0")
    power = (-power if sign == b"-" else power) - decimals
    return more + _MIDDLE_VALUES if power >= _MIDDLE_POWER else more


def _check_memory(text: Text, max_bytes: int) -> None:
    """Check the memory that a message will take; estimate more exactly only above the limit."""
    if _MAX_BYTES_PER_BYTE * len(text) <= max_bytes:
        return
    strings = text.count(b'"') // 2
    width = 1 if text.isascii() and b"\\u" not in text else _WIDE
    numbers = text.count(b",") + text.count(b":")
    other = len(text) + _STRING_BYTES * strings + _NUMBER_BYTES * max(0, numbers - strings)
    if other + width * len(text) <= max_bytes:
        return
    characters = len(text) if strings > _FEW_STRINGS or b'\\"' in text else _characters(text)
    if other + width * characters > max_bytes:
        raise _too_much_memory_error(max_bytes)


def _characters(text: Text) -> int:
    """Return the number of characters between quotes, none of which is escaped."""
    count = 0
    end = -1
    while (begin := text.find(b'"', end + 1)) >= 0:
        end = text.find(b'"', begin + 1)
        if end < 0:
            return len(text)
        count += end - begin
    return count


def _values(text: Text) -> int:
    containers = LIST_VALUES * text.count(b"[") + MAP_VALUES * text.count(b"{")
    return text.count(b",") + text.count(b":") + containers


def _depth(brackets: Text) -> int:
    opening = np.isin(np.frombuffer(brackets, np.uint8), np.frombuffer(b"[{", np.uint8))
    return int(np.cumsum(np.where(opening, np.int8(1), np.int8(-1)), dtype=np.int32).max(initial=0))


def _without_strings(text: Text, dropped: bytes, *, is_separated: bool = False) -> Iterator[bytes]:
    """Yield *text* without its strings and the bytes *dropped*, on request with a space for each string."""
    marks = text.translate(None, dropped) if dropped else text
    if b"\\" in text:
        marks = text.replace(b"\\\\", b"  ").replace(b'\\"', b"  ").translate(None, dropped)
    is_inside = False
    for piece in _pieces(marks):
        signs: npt.NDArray[np.uint8] = np.frombuffer(piece, np.uint8)
        quotes = signs == ord('"')
        inside = np.logical_xor.accumulate(quotes) ^ is_inside
        if is_separated:
            yield np.where(quotes, np.uint8(ord(" ")), signs)[~inside].tobytes()
        else:
            yield signs[~(inside | quotes)].tobytes()
        is_inside = bool(inside[-1])


def _too_many_json_containers_error(most: int) -> LimitExceeded:
    return LimitExceeded(f"JSON of more than {most} lists and objects", hint="send flat lists of numbers")


def _too_deep_json_error(most: int) -> LimitExceeded:
    return LimitExceeded(f"JSON is nested deeper than {most}", hint="send flat lists")


def _too_much_memory_error(max_bytes: int) -> LimitExceeded:
    return LimitExceeded(
        f"a message that would take more than {max_bytes} bytes of memory",
        hint="send arrays of numbers, or large data to the data server",
    )
