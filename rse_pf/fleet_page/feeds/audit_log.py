"""Entries of a local platform's audit log as they are written, in words.

Each entry is checked by its own hash; whether none is missing is `rse-pf audit verify`'s question.  Entries
about heads of chains are left out.  The text in entries may come from robots: it is escaped here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rse_pf.audit.chain import CONTINUED, GAP, HEADS, HEADS_LOST, Chain, Entry
from rse_pf.audit.log import OPERATOR, audit_folder
from rse_pf.fleet_page.feeds.file_tail import FileTail
from rse_pf.identity import RobotId
from rse_pf.terminal import printable

__all__ = ["PLATFORM", "AuditRows", "audit_sentence"]

PLATFORM = "platform."
"""Entries of this kind are the control plane's events."""
_BROKEN = "log.changed"
_MAX_ROWS = 200
_MAX_TEXT = 300


class AuditRows:
    """Reads what is appended to the chains of one platform, and first the end of what is there."""

    def __init__(self, folder: Path) -> None:
        """Read nothing yet; *folder* is that of the platform's state."""
        self._folder = audit_folder(folder)
        self._tail = FileTail()
        self.skipped = 0
        """Entries that came faster than they are shown."""

    def new_entries(self) -> list[tuple[str, Entry | str]]:
        """Return chain and entry of what was written since the last call, oldest first.

        In place of an entry that does not match its hash stands what is wrong with it.
        """
        entries: list[tuple[str, Entry | str]] = []
        files = sorted(self._folder.glob("*.jsonl")) if self._folder.is_dir() else []
        for file in files:
            chain = file.name.partition(".")[0]
            entries += [(chain, Chain(None).add(line + b"\n")) for line in self._tail.new_lines(file)]
        shown = [row for row in entries if isinstance(row[1], str) or row[1].action != HEADS]
        shown.sort(key=lambda row: row[1].time if isinstance(row[1], Entry) else float("inf"))
        self.skipped += max(len(shown) - _MAX_ROWS, 0)
        return shown[-_MAX_ROWS:]

    def new_rows(
        self, *, now_s: float, is_told: Callable[[Entry], bool] = lambda entry: False
    ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Return what the Events view shows of new entries, and events of the platform to be told from them.

        Args:
            now_s: Unix seconds, the time of what is wrong.
            is_told: Whether an event was told already.
        """
        rows: list[dict[str, Any]] = []
        events: list[dict[str, Any]] = []
        for chain, entry in self.new_entries():
            if isinstance(entry, str):
                text = f"a line in the audit log of {chain} was changed (rse-pf audit verify says which)"
                rows.append(_row(chain, _BROKEN, text, time_s=now_s, group="trouble"))
            elif not entry.action.startswith(PLATFORM):
                rows.append(_row(chain, entry.action, audit_sentence(chain, entry), time_s=entry.time))
            elif not is_told(entry):
                kind = entry.action.removeprefix(PLATFORM)
                events.append({"server": entry.subject, **entry.detail, "event": kind, "time_s": entry.time})
        return rows, events


def audit_sentence(chain: str, entry: Entry) -> str:
    """Return an *entry* of the chain *chain* as a sentence; its details if its action has none of its own."""
    values = {name: str(value) for name, value in entry.detail.items()}
    subject = str(RobotId(values["tenant"], entry.subject)) if values.get("tenant") else entry.subject
    actor = values.get("user", entry.actor) if entry.actor == OPERATOR else entry.actor
    text = _SENTENCES.get(entry.action)
    if text is not None:
        return text.format_map(
            _Missing({**values, "subject": subject or "a robot", "actor": actor, "who": chain})
        )
    details = [f"{name} {value}" for name, value in values.items() if name not in ("tenant", "user")]
    by = [f"by {actor}"] if actor != chain else []
    words = " ".join([chain, entry.action.replace(".", " ").replace("-", " "), subject, *by]).strip()
    return f"{words}: {', '.join(details)}" if details else words


def _row(chain: str, kind: str, text: str, *, time_s: float, group: str = "audit") -> dict[str, Any]:
    return {
        "time_s": time_s, "kind": printable(kind), "text": printable(text[:_MAX_TEXT]),
        "server": printable(chain), "group": group,
    }  # fmt: skip


class _Missing(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return "-"


_SENTENCES: Mapping[str, str] = {
    "auth.accepted": "{who} accepted {subject} from {source} (token {token})",
    "auth.cut-off": "{who} ended the connection of {subject}: {reason}",
    "auth.refused": "{who} refused a token from {source}: {reason}",
    "auth.renewal-refused": "{who} refused the fresh token of {subject}: {reason}",
    "auth.renewed": "{subject} renewed its token at {who}",
    "key.rotated": "{actor} made the key {subject}, which signs tokens from now on",
    "map.commit": "{actor} stored version {number} of the map {subject}",
    "map.remove": "{actor} removed version {number} of the map {subject}",
    "map.head": "{actor} made version {number} the head of the map {subject}",
    "robot.adopted": "{actor} gave {subject} what its earlier key stored",
    "robot.disabled": "{actor} disabled {subject}",
    "robot.enabled": "{actor} enabled {subject} again",
    "robot.enrolled": "{actor} enrolled {subject}, which may use {scopes}",
    "robot.removed": "{actor} removed {subject}",
    "server.drain": "{who} drains: its robots are asked to move after {wait_s} s",
    "server.move": "{who} asks {robots} of its robots to move within {spread_s} s",
    "server.native-core-off": "{who} does without the native core from now on, after {crashes} crashes",
    "server.over": "{who} has ended",
    "server.ready": "{who} is ready",
    "server.record": "{who} begins or ends to record {calls} calls of the service {service}",
    "server.robot-shut-out": "{who} refuses {robot} for {seconds} s: its bytes ended two processes",
    "server.services": "{who} loads its services anew",
    "server.unblock": "{who} lifts {lifted} blocks of robots and services",
    "server.worker-crashed": "a worker of {who} ended by signal {signal}, when it computed for {robot}",
    "token.issued": "{actor} issued the token {token} for {subject}",
    "token.revoked": "{actor} revoked the token {token} of {subject}",
    "token.revoked-all": "{actor} revoked all tokens of {subject}",
    CONTINUED: "the audit log of {who} goes on in a new file ({reason})",
    GAP: "entries of {who} are missing in the audit log",
    HEADS_LOST: "{who} made the file of heads again, which was missing",
}
