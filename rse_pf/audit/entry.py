"""Entries of the audit log: what was done, by whom and when.

An entry is one line of JSON, has a bounded size and never contains a token.  Files and clocks are in
`rse_pf.audit.log`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import msgspec

from rse_pf.limits.token_bucket import TokenBucket

__all__ = [
    "REFUSALS_PER_S",
    "REFUSAL_BURST",
    "Entry",
    "RefusalLimiter",
    "Value",
    "entry_line",
    "parse_entry",
]

Value = str | int | float | bool | None

REFUSALS_PER_S = 2.0
"""Refused tokens that a worker or data service records one by one in the long run; others are counted."""
REFUSAL_BURST = 50
"""Refused tokens that a worker or data service records one by one at once."""
_MAX_CHARACTERS = 200
"""Characters of one string; longer ones are cut."""
_MAX_DETAILS = 64
"""Fields of ``detail``; the others are left out."""
_MAX_NUMBER = 2**53
"""Larger numbers are written as strings, because not every reader of JSON has exact integers beyond."""
_JWT_BEGINS = "eyJ"
_TOKEN = re.compile(_JWT_BEGINS + r"[\w-]{5,}\.[\w.-]+")


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """An action to be recorded, or that was recorded; ``time`` is in Unix seconds.

    ``actor`` is who acted: mostly the writer of the log.  Fields of other versions are ignored by a reader.
    """

    time: float
    actor: str
    action: str
    subject: str = ""
    detail: Mapping[str, str | int | float | bool | None] = {}


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(Entry).decode


def entry_line(entry: Entry) -> bytes:
    """Return the line of *entry*, with a newline; long strings are cut, and tokens are masked."""
    detail = list(entry.detail.items())[:_MAX_DETAILS]
    bounded = Entry(
        time=round(float(entry.time), 3), actor=_mask(entry.actor), action=_mask(entry.action),
        subject=_mask(entry.subject), detail={_mask(key): _plain(value) for key, value in detail},
    )  # fmt: skip
    return _encode(bounded) + b"\n"


def parse_entry(line: bytes) -> Entry | None:
    """Return the entry in *line*, None if it is not one, such as a line that a crash cut."""
    try:
        return _decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


class RefusalLimiter:
    """Decide which refusals are recorded one by one; the rest is counted, so that a flood fills no disk."""

    def __init__(self, per_s: float = REFUSALS_PER_S, burst: float = REFUSAL_BURST) -> None:
        self.counted: dict[str, int] = {}
        self._bucket = TokenBucket(per_s, burst)

    def take(self, reason: str, now_s: float) -> bool:
        """Return whether to record this refusal; otherwise it is counted under *reason*."""
        if not self._bucket.take(now_s):
            return True
        self.counted[reason] = self.counted.get(reason, 0) + 1
        return False

    def summary(self) -> dict[str, int]:
        """Return the counts since the last summary, and reset them."""
        counted, self.counted = self.counted, {}
        return counted


def _plain(value: Value) -> Value:
    is_number = isinstance(value, int | float) and math.isfinite(value) and abs(value) < _MAX_NUMBER
    return value if value is None or is_number else _mask(str(value))


def _mask(text: str) -> str:
    if len(text) <= _MAX_CHARACTERS and text.isascii() and _JWT_BEGINS not in text:
        return text
    printable = text[: 4 * _MAX_CHARACTERS].encode("utf-8", "replace").decode()
    return _TOKEN.sub("(a token)", printable)[:_MAX_CHARACTERS]
