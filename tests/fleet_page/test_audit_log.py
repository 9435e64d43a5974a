"""Entries of the audit log are shown as they are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.entry import Entry, entry_line
from rse_pf.extensions.fleet_page.feeds.audit_log import AuditRows, audit_sentence


class Writer:
    """Appends entries to one log."""

    def __init__(self, state: Path, who: str) -> None:
        self.who = who
        self.file = state / "audit" / f"{who}.jsonl"
        self.file.parent.mkdir(exist_ok=True)

    def add(self, action: str, subject: str = "", *, time: float = 1.0, **detail: Any) -> None:
        line = entry_line(Entry(time=time, actor=self.who, action=action, subject=subject, detail=detail))
        with self.file.open("ab") as opened:
            opened.write(line)


def entry(action: str, subject: str, actor: str = "server-1", **detail: Any) -> Entry:
    return Entry(time=1.0, actor=actor, action=action, subject=subject, detail=detail)


@pytest.mark.parametrize(
    ("reported", "sentence"),
    [
        (
            entry("auth.accepted", "lab/robot-1", source="192.0.2.2", token="ab", key="k"),
            "server-1 accepted lab/robot-1 from 192.0.2.2 (token ab)",
        ),
        (
            entry("auth.refused", "", source="192.0.2.2", reason="expired"),
            "server-1 refused a token from 192.0.2.2: expired",
        ),
        (
            entry(
                "auth.refused",
                "",
                source="192.0.2.2",
                reason="disabled",
                claimed_robot="r",
                claimed_tenant="acme",
            ),
            "server-1 refused a token that names acme/r from 192.0.2.2: disabled",
        ),
        (
            entry("auth.refused", "", source="192.0.2.2", reason="unknown-key", claimed_robot="r"),
            "server-1 refused a token that names r from 192.0.2.2: unknown-key",
        ),
        (
            entry("tenant.quota", "acme", "operator", user="ada", data_bytes=5000),
            "ada let the tenant acme store 5000 bytes",
        ),
        (
            entry("token.revoked", "robot-1", "operator", user="ada", tenant="lab", token="ab"),
            "ada revoked the token ab of lab/robot-1",
        ),
        (
            entry("robot.disabled", "robot-1", "operator", user="ada", tenant="default"),
            "ada disabled robot-1",
        ),
        (entry("auth.refused-many", "", expired=7), "server-1 auth refused many: expired 7"),
        (
            entry("new.thing", "x", "operator", user="ada", tenant="lab"),
            "server-1 new thing lab/x by ada",
        ),
    ],
)
def test_an_entry_is_reported_in_words_with_the_tenant_and_the_user(reported: Entry, sentence: str) -> None:
    assert audit_sentence("server-1", reported) == sentence


def test_entries_of_all_logs_are_shown_once_in_their_order_without_lines_that_are_none(
    tmp_path: Path,
) -> None:
    server, operator = Writer(tmp_path, "server-1"), Writer(tmp_path, "operator")
    rows = AuditRows(tmp_path)
    assert rows.new_rows() == ([], [])

    server.add("auth.accepted", "a", time=3.0)
    operator.add("token.issued", "a", time=2.0, user="ada")
    with server.file.open("ab") as opened:
        opened.write(b'{"time":1,"act\n')
    reported, events = rows.new_rows()

    assert [(row["kind"], row["group"], row["server"]) for row in reported] == [
        ("token.issued", "audit", "operator"),
        ("auth.accepted", "audit", "server-1"),
    ]
    assert events == []
    assert rows.new_rows() == ([], [])


def test_a_file_that_is_renamed_is_read_to_its_end(tmp_path: Path) -> None:
    writer, rows = Writer(tmp_path, "server-1"), AuditRows(tmp_path)
    writer.add("server.ready")
    assert len(rows.new_rows()[0]) == 1

    writer.add("auth.accepted", "last-of-the-old")
    writer.file.rename(writer.file.with_name("server-1.000000000001.jsonl"))
    writer.add("auth.accepted", "first-of-the-new")

    assert [row["text"].split()[2] for row in rows.new_rows()[0]] == [
        "last-of-the-old",
        "first-of-the-new",
    ]


def test_hostile_names_are_escaped_and_a_flood_is_bounded(tmp_path: Path) -> None:
    writer, rows = Writer(tmp_path, "server-1"), AuditRows(tmp_path)
    writer.add("auth.accepted", "\x1b[2J<img src=x>\u202e")

    (row,), _ = rows.new_rows()
    assert r"\x1b[2J<img src=x>\u202e" in row["text"]
    for _ in range(1000):
        writer.add("auth.accepted", "robot-1")
    assert len(rows.new_rows()[0]) == 200
    assert rows.skipped == 800
