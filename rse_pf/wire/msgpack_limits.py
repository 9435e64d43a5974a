"""Count the values of a MessagePack message before any object is created from it.

One byte of MessagePack can become a list of 56 bytes in memory, so 256 KiB could become 14 MiB.  Only the
counts are checked here; the decoder reports a message that is malformed.

Source:
    MessagePack specification, https://github.com/msgpack/msgpack/blob/master/spec.md, "Formats".
"""

from __future__ import annotations

from rse_pf.config import SessionSettings
from rse_pf.errors import LimitExceeded

__all__ = ["LIST_VALUES", "MAP_VALUES", "check_msgpack", "too_many_values"]

LIST_VALUES, MAP_VALUES = 3, 6


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


def check_msgpack(data: bytes, limits: SessionSettings) -> None:
    """Raise LimitExceeded if *data* holds too many values, or too many lists and maps.

    According to the memory that they take, a list counts as `LIST_VALUES` values, a map as `MAP_VALUES`, and
    a long string or a raw array as two.  A message too short to exceed a limit is not read.
    """
    max_values, max_containers = limits.max_json_values, limits.max_json_lists
    end = len(data)
    if end <= min(max_values // MAP_VALUES, max_containers):
        return
    at = values = containers = 0
    while at < end:
        step = _STEPS[data[at]]
        values += 1
        if step > 0:
            at += step
        elif step < 0:
            at -= step
            containers += 1
            values += _MORE[data[at + step]]
            if containers > max_containers:
                raise LimitExceeded(f"more than {max_containers} lists and maps", hint="send arrays, raw")
        else:
            width, head = _LENGTHS[data[at]]
            values += 1
            at += head + int.from_bytes(data[at + 1 : at + 1 + width], "big")
        if values > max_values:
            raise too_many_values(max_values)


def too_many_values(max_values: int) -> LimitExceeded:
    """Return the error of a message with more than *max_values* values."""
    return LimitExceeded(
        f"more than {max_values} values in one message", hint="send large data to the data server"
    )
