"""The hash chain of the audit log: what was done, by whom and when, protected against unnoticed changes.

Each entry holds the hash of the previous one, has a bounded size and never contains a token.  `Chain` reports
the first entry that was changed, moved or removed.  A truncated or rewritten end is only detected by a head
that is stored elsewhere.  Files and clocks are in `rse_pf.audit.log`.

Source: S. Haber, W. S. Stornetta, "How to time-stamp a digital document", 1991 (linking).
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from rse_pf.token_bucket import TokenBucket

__all__ = [
    "CONTINUED",
    "GAP",
    "GENESIS",
    "HEADS",
    "HEADS_LOST",
    "REFUSALS_PER_S",
    "REFUSAL_BURST",
    "Chain",
    "Entry",
    "Head",
    "Note",
    "RefusalLimiter",
    "Value",
    "line_of",
    "next_entry",
    "next_line",
    "parse_head",
]

Value = str | int | float | bool | None

CONTINUED, GAP, HEADS, HEADS_LOST = "log.continued", "log.gap", "log.heads", "log.heads-lost"
"""Actions of the log itself: a new file of the chain, lost entries, heads of chains, a lost file of heads."""

_MAX_CHARACTERS, _MAX_DETAILS, _MAX_NUMBER = 200, 64, 2**53
_JWT_BEGINS = "eyJ"
_TOKEN = re.compile(_JWT_BEGINS + r"[\w-]{5,}\.[\w.-]+")
# Canonical JSON: keys in order, no spaces, UTF-8.
_encode = msgspec.json.Encoder(order="sorted").encode
_HEAD = re.compile(r"(\d{1,15}):([0-9a-f]{64})")
REFUSALS_PER_S = 2.0
REFUSAL_BURST = 50
"""Refused tokens that one writer records one by one, in the long run and at once; the rest are counted."""


@dataclass(frozen=True, slots=True)
class Head:
    """The newest entry of a chain: its number, which counts from 1, and its hash in hex."""

    seq: int
    hash: str

    def __str__(self) -> str:
        return f"{self.seq}:{self.hash}"


GENESIS = Head(0, "0" * 64)
"""The head before the first entry of a chain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """An action to be recorded, without secrets; ``time`` is in Unix seconds."""

    time: float
    actor: str
    action: str
    subject: str = ""
    detail: Mapping[str, Value] = field(default_factory=dict)


class Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One line of a log."""

    seq: int
    time: float
    actor: str
    action: str
    subject: str
    detail: dict[str, str | int | float | bool | None]
    previous: str
    hash: str

    @property
    def head(self) -> Head:
        """The head of a chain that ends with this entry."""
        return Head(self.seq, self.hash)


def next_entry(head: Head, note: Note) -> Entry:
    """Return *note* as the entry after *head*; long strings are cut, what looks like a token is masked."""
    return msgspec.json.decode(next_line(head, note)[1], type=Entry)


def next_line(head: Head, note: Note) -> tuple[Head, bytes]:
    """Return the head after *note*, and the line of its entry; see `next_entry`."""
    detail = note.detail
    if len(detail) > _MAX_DETAILS:
        detail = dict(list(detail.items())[:_MAX_DETAILS])
    detail = {_mask(key): _plain(value) for key, value in detail.items()}
    before = _encode(_BeforeHash(_mask(note.action), _mask(note.actor), detail))
    time = round(float(note.time), 3)
    behind = _encode(_BehindHash(head.hash, head.seq + 1, _mask(note.subject), time))
    digest = _digest(before, behind)
    return Head(head.seq + 1, digest), _line(before, digest, behind)


def line_of(entry: Entry) -> bytes:
    """Return *entry* as canonical JSON with a newline."""
    before, behind = _parts(entry)
    return _line(before, entry.hash, behind)


def parse_head(text: str) -> Head | None:
    """Return the head whose string form is *text*, None if it is not one."""
    match = _HEAD.fullmatch(text)
    return None if match is None else Head(int(match[1]), match[2])


class Chain:
    """Check that each line of a chain follows the previous one."""

    def __init__(self, head: Head | None = GENESIS) -> None:
        """Start after *head*; None accepts any first entry."""
        self.head = head

    def add(self, line: bytes) -> Entry | str:
        """Return the entry in *line*, or what is wrong with it; a wrong line does not advance the chain."""
        number = "this entry" if self.head is None else f"entry {self.head.seq + 1}"
        try:
            entry = msgspec.json.decode(line, type=Entry)
            is_canonical = line_of(entry) == line
        except (msgspec.DecodeError, UnicodeDecodeError, ValueError, RecursionError):
            return f"{number} is not readable: the line was changed"
        if not is_canonical or entry.hash != _digest(*_parts(entry)):
            return f"{number} was changed: its hash does not match its content"
        if self.head is not None and (entry.seq, entry.previous) != (self.head.seq + 1, self.head.hash):
            return f"{number} is missing or was changed: entry {entry.seq} is in its place"
        self.head = entry.head
        return entry


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


class _BeforeHash(msgspec.Struct, frozen=True):
    """The members of an entry that stand before its hash in canonical JSON."""

    action: str
    actor: str
    detail: Mapping[str, Value]


class _BehindHash(msgspec.Struct, frozen=True):
    """The members that stand behind it."""

    previous: str
    seq: int
    subject: str
    time: float


def _parts(entry: Entry) -> tuple[bytes, bytes]:
    before = _BeforeHash(entry.action, entry.actor, entry.detail)
    behind = _BehindHash(entry.previous, entry.seq, entry.subject, entry.time)
    return _encode(before), _encode(behind)


def _digest(before: bytes, behind: bytes) -> str:
    """Return the hash of an entry: of its canonical JSON without this hash."""
    return hashlib.sha256(b"%b,%b" % (before[:-1], behind[1:])).hexdigest()


def _line(before: bytes, digest: str, behind: bytes) -> bytes:
    return b'%b,"hash":%b,%b\n' % (before[:-1], _encode(digest), behind[1:])
