"""The summary of a run is computed from its raw records alone."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rse_pf.experiments.results.records import CommandRecord
from rse_pf.experiments.results.summary import (
    longest_outages,
    outage_figures,
    robots_on,
    summarise,
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


def test_a_failure_does_not_count_in_the_round_trip():
    slow = replace(GOOD, id=2, code="expired", round_trip_ms=5000.0)
    assert summarise([GOOD, slow])["round_trip_ms"]["max"] == 40.0


def test_an_empty_run_has_no_percentiles():
    report = summarise([])
    assert report["commands"]["sent"] == 0
    assert report["round_trip_ms"]["p50"] is None
    assert report["payload_bytes"] == {"median": None, "max": None}


def answers(robot, server, times, *, planned=None, code="ok"):
    return [
        CommandRecord(
            id=number, robot=robot, planned=planned[number] if planned else time_s - 0.01,
            sent=time_s - 0.01, answered=time_s, server=server, code=code, round_trip_ms=10.0,
        )
        for number, time_s in enumerate(times)
    ]  # fmt: skip


def asked_in_vain(robot, times, code=""):
    return [
        CommandRecord(
            id=1000 + n,
            robot=robot,
            planned=t,
            sent=t,
            answered=t + 1 if code else None,
            server="",
            code=code,
        )
        for n, t in enumerate(times)
    ]


def test_a_failure_is_no_answer_of_a_server():
    assert robots_on(answers("r", "a", [1.0], code="busy"), "a", 2.0) == set()


def test_an_outage_before_the_fault_or_after_the_watched_time_does_not_count():
    commands = answers("r", "a", [0.0, 3.0, 3.2, 3.4, 3.9, 4.1, 4.3, 9.0])

    silences = longest_outages(commands, {"r"}, start_s=3.5, end_s=4.2)

    assert silences["r"] == pytest.approx(0.5)


def test_failures_do_not_end_an_outage():
    commands = [*answers("r", "a", [1.0, 4.0]), *asked_in_vain("r", [1.5], code="busy")]

    assert longest_outages(commands, {"r"}, start_s=1.1, end_s=3.0)["r"] == pytest.approx(3.0)


def test_a_robot_that_was_never_answered_is_counted():
    figures = outage_figures(asked_in_vain("r", [1.0, 7.0]), {"r"}, start_s=1.0, end_s=3.0)

    assert figures == {"robots": 1, "p50": 6.0, "p99": 6.0, "max": 6.0}


def test_the_outage_of_a_robot_without_further_answers_ends_with_its_last_command():
    commands = [*answers("r", "a", [1.0, 1.2]), *asked_in_vain("r", [1.4, 8.0])]

    assert longest_outages(commands, {"r"}, start_s=1.3, end_s=3.0)["r"] == pytest.approx(6.8)
