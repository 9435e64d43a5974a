"""Weak and failed commands are read from the servers' logs, also while these are written and rotated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rse_pf.extensions.fleet_page.feeds.command_log import CommandLog


def line(**fields: Any) -> str:
    return json.dumps({"time": 1.0, "event": "command", "code": "no-consensus", **fields}) + "\n"


def test_weak_and_failed_commands_are_told_and_others_are_not(tmp_path: Path) -> None:
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


def test_each_line_is_told_once_and_only_when_it_is_complete(tmp_path: Path) -> None:
    file, log = tmp_path / "server-1.log", CommandLog(tmp_path)
    whole = line(robot="a")
    file.write_text(whole + whole[:20])
    assert len(log.new_rows()) == 1

    with file.open("a") as opened:
        opened.write(whole[20:])
    assert len(log.new_rows()) == 1
    assert log.new_rows() == []

    file.write_text(line(robot="new"))  # it was set aside, and begun anew
    assert [row["robot"] for row in log.new_rows()] == ["new"]


def test_hostile_texts_are_escaped_and_cut(tmp_path: Path) -> None:
    (tmp_path / "server-1.log").write_text(
        line(robot="\x1b[2J\u202e<img src=x>", trace="t" * 9999, id={"a": 1})
    )

    (row,) = CommandLog(tmp_path).new_rows()

    assert row["robot"] == r"\x1b[2J\u202e<img src=x>"
    assert len(row["trace"]) == 200
    assert row["id"] == "{'a': 1}"


def test_a_flood_of_failures_costs_a_bounded_number_of_rows(tmp_path: Path) -> None:
    log = CommandLog(tmp_path)
    log.new_rows()
    (tmp_path / "server-1.log").write_text(line(robot="a") * 50_000)

    assert len(log.new_rows()) <= 200
    assert log.skipped > 0
