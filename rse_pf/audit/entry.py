"""Entries of the audit log: what was done, by whom and when.

An entry is one line of JSON of limited size, in which JSON Web Tokens are masked.  The files of the audit log
are in `rse_pf.audit.log`.
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
"""Type of the values in the detail of an entry."""

REFUSALS_PER_S = 2.0
"""Refusals per second of which each gets an entry of its own in the long run, for one worker or data server;
further refusals are only counted, so that refused requests cannot fill the disk."""
REFUSAL_BURST = 50
"""Largest number of refusals that get an entry each at once, after a time without refusals."""
_MAX_CHARACTERS = 200
"""Longest string in an entry, in characters; a longer string is cut."""
_MAX_DETAILS = 64
"""Largest number of fields in the detail of an entry; further fields are left out."""
_MAX_NUMBER = 2**53
"""Numbers whose absolute value is not below this limit are written as strings, because many readers of JSON
store numbers as float64 and would round larger integers."""
_JWT_BEGINS = "eyJ"  # first characters of every JSON Web Token: ``{"`` in base64
_TOKEN = re.compile(_JWT_BEGINS + r"[\w-]{5,}\.[\w.-]+")


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """An entry of the audit log, as it is passed to a writer or was read from a file.

    A reader ignores fields that it does not know, which other versions may write.

    Attributes:
        time: When the action happened, in Unix seconds.
        actor: Who acted; mostly the name of the log.
        action: What was done, such as ``robot.enrolled``.
        subject: On what the action was done, such as a robot; "" if that is clear.
        detail: Further names, numbers and reasons.
    """

    time: float
    actor: str
    action: str
    subject: str = ""
    detail: Mapping[str, str | int | float | bool | None] = {}


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(Entry).decode


def entry_line(entry: Entry) -> bytes:
    """Return *entry* as a line of JSON with a newline.

    Strings are cut to 200 characters and the detail to 64 fields; JSON Web Tokens are replaced by
    ``(a token)``; numbers that JSON cannot represent exactly are written as strings.
    """
    detail = list(entry.detail.items())[:_MAX_DETAILS]
    bounded = Entry(
        time=round(float(entry.time), 3), actor=_mask(entry.actor), action=_mask(entry.action),
        subject=_mask(entry.subject), detail={_mask(key): _plain(value) for key, value in detail},
    )  # fmt: skip
    return _encode(bounded) + b"\n"


def parse_entry(line: bytes) -> Entry | None:
    """Return the entry in *line*; None if the line is not a valid entry, such as one that a crash cut off."""
    try:
        return _decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


class RefusalLimiter:
    """Limit the rate of refusals that get an entry each; refusals above it are only counted.

    A token bucket lets *burst* refusals pass at once, and *per_s* per second in the long run.

    Attributes:
        counted: Number of refusals above the rate since the last `summary`, by reason.
    """

    def __init__(self, per_s: float = REFUSALS_PER_S, burst: float = REFUSAL_BURST) -> None:
        self.counted: dict[str, int] = {}
        self._bucket = TokenBucket(per_s, burst)

    def take(self, reason: str, now_s: float) -> bool:
        """Return whether a refusal at *now_s* (monotonic) gets an entry; if not, count it under *reason*."""
        if not self._bucket.take(now_s):
            return True
        self.counted[reason] = self.counted.get(reason, 0) + 1
        return False

    def summary(self) -> dict[str, int]:
        """Return the number of refusals without an entry since the last summary, by reason, and reset it."""
        counted, self.counted = self.counted, {}
        return counted


def _plain(value: Value) -> Value:
    """Return *value* if it is None or a number below `_MAX_NUMBER`; otherwise as a masked string."""
    is_number = isinstance(value, int | float) and math.isfinite(value) and abs(value) < _MAX_NUMBER
    return value if value is None or is_number else _mask(str(value))


def _mask(text: str) -> str:
    """Return *text*, cut to `_MAX_CHARACTERS`, with ``(a token)`` in place of each JSON Web Token."""
    if len(text) <= _MAX_CHARACTERS and text.isascii() and _JWT_BEGINS not in text:
        return text
    printable = text[: 4 * _MAX_CHARACTERS].encode("utf-8", "replace").decode()
    return _TOKEN.sub("(a token)", printable)[:_MAX_CHARACTERS]
