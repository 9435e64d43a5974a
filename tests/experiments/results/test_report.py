"""The report is computed from the raw records alone, and counts what others hide."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest

from rse_pf.errors import UsageError
from rse_pf.experiments.results.report import (
    CommandRecord,
    EventLog,
    percentiles,
    read_commands,
    summarise,
    write_commands,
)

GOOD = CommandRecord(
    id=1, robot="robot-1", planned=0.0, sent=0.01, answered=0.05, server="a", code="ok",
    payload_bytes=100, round_trip_ms=40.0, compute_ms=3.0,
)  # fmt: skip


def test_counts_answered_failed_lost_and_twice():
    commands = [
        GOOD,
        replace(GOOD, id=2, code="busy", server=""),
        replace(GOOD, id=3, code="", answered=None, server=""),
        replace(GOOD, id=4),
        replace(GOOD, id=4, server="b"),
        replace(GOOD, id=5, source="robot", server="robot"),
    ]

    report = summarise(commands)

    assert report["commands"] == {
        "sent": 5, "answered": 3, "failed": 1, "lost": 1, "twice": 1, "answered_by_robot": 1,
    }  # fmt: skip
    assert report["failures_by_code"] == {"busy": 1}
    assert report["commands_by_server"] == {"a": 2, "b": 1, "robot": 1}


def test_the_same_id_of_two_robots_is_two_commands():
    assert summarise([GOOD, replace(GOOD, robot="robot-2")])["commands"]["sent"] == 2
    assert summarise([GOOD, replace(GOOD, robot="robot-2")])["commands"]["twice"] == 0


def test_a_failure_does_not_count_in_the_round_trip():
    slow = replace(GOOD, id=2, code="expired", round_trip_ms=5000.0)
    assert summarise([GOOD, slow])["round_trip_ms"]["max"] == 40.0


def test_an_empty_run_has_no_percentiles():
    report = summarise([])
    assert report["commands"]["sent"] == 0
    assert report["round_trip_ms"]["p50"] is None
    assert report["payload_bytes"] == {"median": None, "max": None}


def test_percentiles_are_those_of_the_values():
    assert percentiles([1.0, 2.0, 3.0, 4.0, 5.0])["p50"] == 3.0
    assert percentiles(list(map(float, range(101))))["p95"] == 95.0


def test_records_survive_the_file(tmp_path):
    commands = [GOOD, replace(GOOD, id=2, code="", answered=None, round_trip_ms=None)]
    write_commands(tmp_path / "commands.csv", commands)
    assert read_commands(tmp_path / "commands.csv") == commands


def test_a_broken_file_is_one_line_with_a_hint(tmp_path):
    (tmp_path / "commands.csv").write_text("id,robot\nx,y\n")
    with pytest.raises(UsageError, match="cannot read"):
        read_commands(tmp_path / "commands.csv")
    with pytest.raises(UsageError, match="cannot read"):
        read_commands(tmp_path / "nothing.csv")


def test_events_are_lines_of_json_written_at_once():
    file = io.StringIO()
    EventLog(file).write(1.5, "server-killed", server="a", pid=7)
    assert json.loads(file.getvalue()) == {"time": 1.5, "action": "server-killed", "server": "a", "pid": 7}
