"""Outages around a fault count for the affected robots, and for no others."""

from __future__ import annotations

import pytest

from rse_pf.experiments.results.outages import longest_outages, outage_figures, robots_on
from rse_pf.experiments.results.records import CommandRecord


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


def test_a_robot_is_on_the_server_that_answered_it_last_before_the_fault():
    commands = [
        *answers("moved", "a", [1.0]),
        *answers("moved", "b", [1.5]),
        *answers("stayed", "a", [1.2]),
        *answers("later", "a", [2.5]),
    ]

    assert robots_on(commands, "a", 2.0) == {"stayed"}
    assert robots_on(commands, "b", 2.0) == {"moved"}


def test_a_failure_is_no_answer_of_a_server():
    assert robots_on(answers("r", "a", [1.0], code="busy"), "a", 2.0) == set()


def test_the_outage_is_the_longest_time_without_answers_that_overlaps_the_fault():
    commands = answers("r", "a", [0.0, 3.0, 3.2, 3.4, 4.9, 5.1, 9.0])

    silences = longest_outages(commands, {"r"}, start_s=3.5, end_s=6.0)

    assert silences == {"r": pytest.approx(3.9)}


def test_an_outage_before_the_fault_or_after_the_watched_time_does_not_count():
    commands = answers("r", "a", [0.0, 3.0, 3.2, 3.4, 3.9, 4.1, 4.3, 9.0])

    silences = longest_outages(commands, {"r"}, start_s=3.5, end_s=4.2)

    assert silences["r"] == pytest.approx(0.5)


def test_the_outage_of_a_robot_without_further_answers_ends_with_its_last_command():
    commands = [*answers("r", "a", [1.0, 1.2]), *asked_in_vain("r", [1.4, 8.0])]

    assert longest_outages(commands, {"r"}, start_s=1.3, end_s=3.0)["r"] == pytest.approx(6.8)


def test_failures_do_not_end_an_outage():
    commands = [*answers("r", "a", [1.0, 4.0]), *asked_in_vain("r", [1.5], code="busy")]

    assert longest_outages(commands, {"r"}, start_s=1.1, end_s=3.0)["r"] == pytest.approx(3.0)


def test_a_robot_that_was_never_answered_is_counted():
    figures = outage_figures(asked_in_vain("r", [1.0, 7.0]), {"r"}, start_s=1.0, end_s=3.0)

    assert figures == {"robots": 1, "p50": 6.0, "p99": 6.0, "max": 6.0}


def test_unaffected_robots_do_not_change_the_percentiles():
    commands = [*answers("hit", "a", [1.0, 3.0]), *answers("other", "b", [1.0, 1.2, 1.4, 3.0])]

    assert outage_figures(commands, {"hit"}, start_s=1.1, end_s=2.0)["p50"] == pytest.approx(2.0)
