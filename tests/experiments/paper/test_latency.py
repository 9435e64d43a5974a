"""Figures of a latency run: the parts of the round trip beside those of the paper."""

from __future__ import annotations

import pytest

from rse_pf.experiments.paper.latency import latency_figures
from rse_pf.experiments.results.records import CommandRecord, Records

ASKED = {"time": 0.0, "action": "experiment", "kind": "latency", "link_round_trip_ms": 130.0}


def command(number, robot="robot-1", **more):
    fields = {
        "id": number, "robot": robot, "planned": number / 5, "sent": number / 5,
        "answered": number / 5 + 0.136, "server": "server-1", "code": "ok", "round_trip_ms": 136.0,
        "up_ms": 66.0, "queue_ms": 1.0, "compute_ms": 2.0, "down_ms": 66.0,
    }  # fmt: skip
    return CommandRecord(**{**fields, **more})


def judge(commands):
    return latency_figures(Records(commands=commands, events=[ASKED], samples=[]))


def test_the_parts_and_the_rest_make_the_round_trip():
    judged = judge([command(number) for number in range(20)])

    assert judged["rest_ms_mean"] == pytest.approx(1.0)
    assert judged["over_the_link_ms_p50"] == pytest.approx(6.0)
    assert judged["against_paper"] == {"round_trip_ms": -20.36, "compute_ms": -27.82}


def test_a_failed_command_was_not_answered_in_time():
    late = command(3, round_trip_ms=151.0)
    failed = command(4, code="busy", round_trip_ms=10.0)

    judged = judge([command(1), command(2), late, failed])

    assert judged["answered_within_150_ms_percent"] == 50.0


def test_the_frame_rate_counts_answers_not_commands():
    commands = [command(number) for number in range(11)]
    commands += [command(number, "robot-2", code="busy" if number % 2 else "ok") for number in range(11)]

    judged = judge(commands)

    assert judged["fps_per_robot"]["least"] == pytest.approx(5.0 * 6 / 11, abs=1e-3)
    assert judged["fps_per_robot"]["mean"] == pytest.approx((5.0 + 5.0 * 6 / 11) / 2, abs=1e-3)


def test_without_clocks_there_is_no_rest():
    assert judge([command(1, up_ms=None, down_ms=None)])["rest_ms_mean"] is None
