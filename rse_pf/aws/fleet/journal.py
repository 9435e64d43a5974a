"""Read this machine's systemd journal: the output of the servers, the agent and the boot.

Entries come from journalctl as JSON, one a line, and become lines of text.  The next reading begins after
systemd's cursor of the last entry.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone

import msgspec

__all__ = ["UNITS", "Batch", "JournalReader", "journal_command", "make_batch", "read_journal"]

UNITS = (
    "rse-pf.service", "rse-pf-agent.service", "rse-pf-data.service",
    "rse-pf-rosbridge.service", "cloud-init.service", "cloud-final.service",
)  # fmt: skip
"""systemd units whose entries are read; the last two hold the output of first_boot.py and install.py."""
# Size at which a batch of lines ends, in bytes: a batch of this size uploads in less than a second.
_MAX_BATCH_BYTES = 1 << 22
_JOURNAL_FIELDS = "_SYSTEMD_UNIT,UNIT,MESSAGE"

JournalReader = Callable[[str], Iterable[bytes]]
"""Returns the journal's entries after a cursor, as JSON lines; "" means all entries since the boot."""


class _Entry(msgspec.Struct, frozen=True):
    """One entry of the journal; journalctl exports a message that is not UTF-8 as a list of its bytes."""

    cursor: str = msgspec.field(name="__CURSOR")
    realtime_us: str = msgspec.field(name="__REALTIME_TIMESTAMP")
    message: str | list[int] | None = msgspec.field(name="MESSAGE", default=None)
    unit: str = msgspec.field(name="_SYSTEMD_UNIT", default="")
    about: str = msgspec.field(name="UNIT", default="")

    @property
    def line(self) -> str:
        """Return the entry as a line of text: time in UTC, unit and message.

        An example is ``2026-11-23T04:00:00.123Z rse-pf message``.
        """
        at = datetime.fromtimestamp(int(self.realtime_us) / 1e6, timezone.utc)
        text = (
            bytes(self.message).decode("utf-8", "replace") if isinstance(self.message, list) else self.message
        )
        stamp = at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
        return f"{stamp} {(self.about or self.unit).removesuffix('.service')} {text or ''}\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Lines of a journal as UTF-8 text, the time of the first (Unix microseconds), the cursor of the last."""

    first_us: int
    text: bytes
    cursor: str


def make_batch(entries: Iterable[bytes], max_bytes: int = _MAX_BATCH_BYTES) -> Batch | None:
    """Return the first *entries* as one batch, which ends with the line that reaches *max_bytes*.

    None if there are no entries.  An entry that cannot be decoded is left out.
    """
    first_us, cursor, size = 0, "", 0
    lines: list[bytes] = []
    for encoded in entries:
        try:
            entry = msgspec.json.decode(encoded, type=_Entry)
            line = entry.line.encode()
        except (msgspec.DecodeError, ValueError, OverflowError):
            continue
        first_us = first_us or int(entry.realtime_us)
        cursor = entry.cursor
        lines.append(line)
        size += len(line)
        if size >= max_bytes:
            break
    return Batch(first_us=first_us, text=b"".join(lines), cursor=cursor) if lines else None


def journal_command(cursor: str) -> list[str]:
    """Return the journalctl command that prints the entries of `UNITS` after *cursor*; "": since the boot."""
    command = [
        "/usr/bin/journalctl",
        "--output=json",
        f"--output-fields={_JOURNAL_FIELDS}",
        "--no-pager",
        "--quiet",
    ]
    command += [f"--unit={unit}" for unit in UNITS]
    return command + ([f"--after-cursor={cursor}"] if cursor else ["--boot"])


def read_journal(cursor: str) -> Iterator[bytes]:
    """Yield the entries of `UNITS` after *cursor* on this machine, as JSON lines; raises OSError."""
    with subprocess.Popen(
        journal_command(cursor), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        try:
            yield from process.stdout
        finally:
            process.kill()
