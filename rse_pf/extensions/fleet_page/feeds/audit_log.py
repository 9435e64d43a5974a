"""Read new entries of a local platform's audit logs, and describe each as a sentence.

A line that is no valid entry is ignored.  Texts in entries may come from robots, and are escaped here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rse_pf.audit.entry import Entry, parse_entry
from rse_pf.audit.log import OPERATOR, audit_folder
from rse_pf.extensions.fleet_page.feeds.file_tail import FileTail
from rse_pf.identity import RobotId
from rse_pf.local.events import PLATFORM
from rse_pf.terminal import printable

__all__ = ["AuditRows", "audit_sentence"]

# Largest number of entries that are shown after one reading; of more, the newest are shown.
_MAX_ROWS = 200
# Largest number of characters of a sentence.
_MAX_TEXT = 300


class AuditRows:
    """Reads the audit logs of one platform: at first their last lines, then what is appended."""

    def __init__(self, folder: Path) -> None:
        """Prepare to read the audit logs of the platform whose state is in *folder*; nothing is read yet."""
        self._folder = audit_folder(folder)
        self._tail = FileTail()
        self.skipped = 0
        """Number of entries that were not shown, because one reading found more than 200."""

    def new_entries(self) -> list[tuple[str, Entry]]:
        """Return the entries written since the last call, each with the name of its log, oldest first."""
        entries: list[tuple[str, Entry]] = []
        files = sorted(self._folder.glob("*.jsonl")) if self._folder.is_dir() else []
        for file in files:
            parsed = map(parse_entry, self._tail.new_lines(file))
            entries += [(file.name.partition(".")[0], entry) for entry in parsed if entry is not None]
        entries.sort(key=lambda row: row[1].time)
        self.skipped += max(len(entries) - _MAX_ROWS, 0)
        return entries[-_MAX_ROWS:]

    def new_rows(
        self, is_reported: Callable[[Entry], bool] = lambda entry: False
    ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Return the new entries in two lists: rows of the Events view, and events of the control plane.

        An entry whose action begins with `PLATFORM` is in the list of events of the control plane, every
        other entry is a row.  The caller makes rows of these events, as of the events in the control plane's
        stream.

        Args:
            is_reported: Returns whether the stream of the control plane has reported an event already; such
                an event is in neither list.
        """
        rows: list[dict[str, Any]] = []
        events: list[dict[str, Any]] = []
        for who, entry in self.new_entries():
            if not entry.action.startswith(PLATFORM):
                rows.append(_row(who, entry))
            elif not is_reported(entry):
                kind = entry.action.removeprefix(PLATFORM)
                events.append({"server": entry.subject, **entry.detail, "event": kind, "time_s": entry.time})
        return rows, events


def audit_sentence(who: str, entry: Entry) -> str:
    """Return *entry* of the log named *who* as a sentence.

    An action without a sentence in `_SENTENCES` is described by its name, subject and details.
    """
    values = {name: str(value) for name, value in entry.detail.items()}
    subject = str(RobotId(values["tenant"], entry.subject)) if values.get("tenant") else entry.subject
    actor = values.get("user", entry.actor) if entry.actor == OPERATOR else entry.actor
    text = _SENTENCES.get(entry.action)
    if text is not None:
        named = {"subject": subject or "a robot", "actor": actor, "who": who, "claim": _claim(values)}
        return text.format_map(_Missing({**values, **named}))
    details = [f"{name} {value}" for name, value in values.items() if name not in ("tenant", "user")]
    by = [f"by {actor}"] if actor != who else []
    words = " ".join([who, entry.action.replace(".", " ").replace("-", " "), subject, *by]).strip()
    return f"{words}: {', '.join(details)}" if details else words


def _claim(values: Mapping[str, str]) -> str:
    """Return the part of a sentence with the robot that a rejected token names; empty if it names none."""
    robot, tenant = values.get("claimed_robot"), values.get("claimed_tenant")
    if not robot:
        return ""
    return f" that names {RobotId(tenant, robot) if tenant else robot}"


def _row(who: str, entry: Entry) -> dict[str, Any]:
    return {
        "time_s": entry.time, "kind": printable(entry.action),
        "text": printable(audit_sentence(who, entry)[:_MAX_TEXT]), "server": printable(who), "group": "audit",
    }  # fmt: skip


class _Missing(dict[str, str]):
    def __missing__(self, key: str) -> str:
        return "-"


# The sentence for each action of an entry; names in braces are members of the entry.
_SENTENCES: Mapping[str, str] = {
    "auth.accepted": "{who} accepted {subject} from {source} (token {token})",
    "auth.cut-off": "{who} ended the connection of {subject}: {reason}",
    "auth.refused": "{who} refused a token{claim} from {source}: {reason}",
    "auth.renewal-refused": "{who} refused the fresh token of {subject}: {reason}",
    "auth.renewed": "{subject} renewed its token at {who}",
    "key.rotated": "{actor} made the key {subject}, which signs tokens from now on",
    "map.commit": "{actor} stored version {number} of the map {subject}",
    "map.remove": "{actor} removed version {number} of the map {subject}",
    "map.restore": "{actor} restored the map {subject}, with version {number} as its head",
    "map.head": "{actor} made version {number} the head of the map {subject}",
    "robot.adopted": "{actor} gave {subject} the objects that its earlier key stored",
    "robot.disabled": "{actor} disabled {subject}",
    "robot.enabled": "{actor} enabled {subject} again",
    "robot.enrolled": "{actor} enrolled {subject}, which may use {scopes}",
    "robot.quota": "{actor} let {subject} store {limit}",
    "robot.removed": "{actor} removed {subject}",
    "server.drain": "{who} drains: its robots are asked to move after {wait_s} s",
    "server.move": "{who} asks {robots} of its robots to move within {spread_s} s",
    "server.over": "{who} has exited",
    "server.ready": "{who} is ready",
    "server.robot-shut-out": "{who} refuses {robot} for {seconds} s: its bytes ended two processes",
    "server.services": "{who} reloads its services",
    "server.unblock": "{who} removed {lifted} blocks of robots and services",
    "server.worker-crashed": "a worker of {who} ended by signal {signal}, when it computed for {robot}",
    "tenant.quota": "{actor} let the tenant {subject} store {data_bytes} bytes",
    "token.issued": "{actor} issued the token {token} for {subject}",
    "token.revoked": "{actor} revoked the token {token} of {subject}",
    "token.revoked-all": "{actor} revoked all tokens of {subject}",
    "log.gap": "{entries} entries of {who} are missing in the audit log",
}
