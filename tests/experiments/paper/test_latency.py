"""Figures of a latency run: the parts of the round trip beside those of the paper."""

from __future__ import annotations

from rse_pf.extensions.experiments.paper.latency import latency_figures
from rse_pf.extensions.experiments.results.records import CommandRecord, Records

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


def test_a_failed_command_was_not_answered_in_time():
    late = command(3, round_trip_ms=151.0)
    failed = command(4, code="busy", round_trip_ms=10.0)

    judged = judge([command(1), command(2), late, failed])

    assert judged["answered_within_150_ms_percent"] == 50.0
