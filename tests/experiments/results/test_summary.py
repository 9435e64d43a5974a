"""The summary of a run is computed from its raw records alone."""

from __future__ import annotations

from dataclasses import replace

from rse_pf.experiments.results.records import CommandRecord
from rse_pf.experiments.results.summary import percentiles, summarise

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
