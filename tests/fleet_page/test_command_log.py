"""Weak and failed commands are read from the servers' logs, also while these are written and rotated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rse_pf.extensions.fleet_page.feeds.command_log import CommandLog


def line(**fields: Any) -> str:
    return json.dumps({"time": 1.0, "event": "command", "code": "no-consensus", **fields}) + "\n"


def test_weak_and_failed_commands_are_reported_and_others_are_not(tmp_path: Path) -> None:
    log = tmp_path / "server-1.log"
    log.write_text(
        line(robot="a", time=2.0)
        + line(robot="b", code="ok", verdict="weak", reason="few-inliers")
        + line(code="ok")
        + line(code="busy")
        + '{"event":"ready","time":1.0}\nno json "command"\n[1,"command"]\n'
    )

    rows = CommandLog(tmp_path).new_rows()

    assert [(row["robot"], row["code"]) for row in rows] == [("b", "ok"), ("a", "no-consensus")]
    assert rows[0]["reason"] == "few-inliers"


def test_hostile_texts_are_escaped_and_cut(tmp_path: Path) -> None:
    (tmp_path / "server-1.log").write_text(
        line(robot="\x1b[2J\u202e<img src=x>", trace="t" * 9999, id={"a": 1})
    )

    (row,) = CommandLog(tmp_path).new_rows()

    assert row["robot"] == r"\x1b[2J\u202e<img src=x>"
    assert len(row["trace"]) == 200
    assert row["id"] == "{'a': 1}"
