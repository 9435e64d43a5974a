"""What was done, by whom and when, as a chain in which nothing can be changed, moved or left out unseen.

Each entry names the hash of the one before it.  Promises no clock and no file (`rse_pf.audit.log` has
them), that an entry is bounded and never holds a token, and that `Chain` names the first entry that is
wrong.  What it cannot see by itself is an end that was cut off or written anew: for that, heads are kept
elsewhere.

Source: S. Haber, W. S. Stornetta, "How to time-stamp a digital document", 1991 (linking).
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

__all__ = [
    "CONTINUED",
    "GAP",
    "GENESIS",
    "HEADS",
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
    "parse_head",
]

Value = str | int | float | bool | None

CONTINUED, GAP, HEADS = "log.continued", "log.gap", "log.heads"
"""Actions of the log itself: a new file of the same chain, entries that were lost, heads of other chains."""

_MAX_LETTERS, _MAX_DETAILS, _MAX_NUMBER = 200, 64, 2**53
_TOKEN = re.compile(r"eyJ[\w-]{5,}\.[\w.-]+")
_encode = msgspec.json.Encoder(order="sorted").encode
"""Keys in order, no space, UTF-8: with the same text, every reader makes the same bytes."""
_HEAD_WORD = re.compile(r"(\d{1,15}):([0-9a-f]{64})")
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
"""What the first entry of a chain follows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """Something to be recorded.  ``time`` is in Unix seconds; names and reasons alone, nothing secret."""

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
        """The head of a chain that ends here."""
        return Head(self.seq, self.hash)


def next_entry(head: Head, note: Note) -> Entry:
    """Return *note* as the entry after *head*; long words are cut, what looks like a token is hidden."""
    details = list(note.detail.items())[:_MAX_DETAILS]
    open_entry = Entry(
        seq=head.seq + 1,
        time=round(float(note.time), 3),
        actor=_safe(note.actor),
        action=_safe(note.action),
        subject=_safe(note.subject),
        detail={_safe(key): _plain(value) for key, value in details},
        previous=head.hash,
        hash="",
    )
    return msgspec.structs.replace(open_entry, hash=_hash_of(open_entry))


def line_of(entry: Entry) -> bytes:
    """Return the one way to write *entry*: canonical JSON and a newline."""
    return _canonical(msgspec.structs.asdict(entry)) + b"\n"


def parse_head(text: str) -> Head | None:
    """Return the head that ``str`` made *text* of; None if it is none."""
    found = _HEAD_WORD.fullmatch(text)
    return None if found is None else Head(int(found[1]), found[2])


class Chain:
    """Reads the lines of one chain, in order, and knows whether each follows the one before."""

    def __init__(self, head: Head | None = GENESIS) -> None:
        """Begin behind *head*; None believes what the first entry says."""
        self.head = head

    def add(self, line: bytes) -> Entry | str:
        """Return the entry in *line*, or what is wrong with it; a wrong line is not gone past."""
        number = "this entry" if self.head is None else f"entry {self.head.seq + 1}"
        try:
            entry = msgspec.json.decode(line, type=Entry)
            is_written_so = line_of(entry) == line
        except (msgspec.DecodeError, UnicodeDecodeError, ValueError, RecursionError):
            return f"{number} is not readable: the line was changed"
        if not is_written_so or entry.hash != _hash_of(entry):
            return f"{number} was changed: its hash is not that of what it says"
        if self.head is not None and (entry.seq, entry.previous) != (self.head.seq + 1, self.head.hash):
            return f"{number} is missing or was changed: entry {entry.seq} stands in its place"
        self.head = entry.head
        return entry


class RefusalLimiter:
    """How many refusals are written one by one; the rest are counted, so that a flood fills no disk."""

    def __init__(self, per_s: float = REFUSALS_PER_S, burst: float = REFUSAL_BURST) -> None:
        self.counted: dict[str, int] = {}
        self._per_s = per_s
        self._burst = burst
        self._room = burst
        self._at_s = float("-inf")

    def take(self, reason: str, now_s: float) -> bool:
        """Return whether this one is written; if not, it is counted under *reason*."""
        self._room = min(self._burst, self._room + max(0.0, now_s - self._at_s) * self._per_s)
        self._at_s = max(now_s, self._at_s)
        if self._room >= 1:
            self._room -= 1
            return True
        self.counted[reason] = self.counted.get(reason, 0) + 1
        return False

    def summary(self) -> dict[str, int]:
        """Return and forget what was counted."""
        counted, self.counted = self.counted, {}
        return counted


def _plain(value: Value) -> Value:
    is_number = isinstance(value, int | float) and math.isfinite(value) and abs(value) < _MAX_NUMBER
    return value if value is None or is_number else _safe(str(value))


def _safe(text: str) -> str:
    shown = text[: 4 * _MAX_LETTERS].encode("utf-8", "replace").decode()
    return _TOKEN.sub("(a token)", shown)[:_MAX_LETTERS]


def _hash_of(entry: Entry) -> str:
    fields = msgspec.structs.asdict(entry)
    del fields["hash"]
    return hashlib.sha256(_canonical(fields)).hexdigest()


def _canonical(fields: Mapping[str, object]) -> bytes:
    return _encode(fields)
