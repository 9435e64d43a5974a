"""Judge a latency run by its raw records: the paper's 156.36 ms taken apart by the robots' own clocks.

Up and down come from the four stamps of pings and answers; queue and compute are the server's.  Promises
means where the paper has means, percentiles beside them, and no figure that the records do not carry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rse_pf.experiments.results.records import Records, asked_of, summary_of
from rse_pf.experiments.results.report import PAPER, ROUND_TRIP_PARTS, CommandRecord

__all__ = ["judge_latency"]


def judge_latency(records: Records) -> dict[str, Any]:
    """Return round trip, its parts and the frame rate; raises UsageError if nothing says what was asked."""
    asked = asked_of(records)
    summary = summary_of(records)
    trip = summary["round_trip_ms"]
    known = {name: summary[name]["mean"] for name in ROUND_TRIP_PARTS}
    rest = None
    if trip["mean"] is not None and all(value is not None for value in known.values()):
        rest = round(trip["mean"] - sum(known.values()), 3)
    link_ms = float(asked.get("link_round_trip_ms") or 0.0)
    return {
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "payload_bytes": summary["payload_bytes"],
        "round_trip_ms": trip,
        **{name: summary[name] for name in ROUND_TRIP_PARTS},
        "rest_ms_mean": rest,
        "over_the_link_ms_p50": None if trip["p50"] is None else round(trip["p50"] - link_ms, 3),
        "answered_within_150_ms_percent": _within(records.commands, 150.0),
        "fps_per_robot": _fps(records.commands),
        "against_paper": {
            "round_trip_ms": None
            if trip["mean"] is None
            else round(trip["mean"] - PAPER["round_trip_ms"], 3),
            "compute_ms": (
                None if known["compute_ms"] is None else round(known["compute_ms"] - PAPER["compute_ms"], 3)
            ),
        },
    }


def _within(commands: Sequence[CommandRecord], limit_ms: float) -> float | None:
    if not commands:
        return None
    good = sum(
        each.code == "ok" and each.round_trip_ms is not None and each.round_trip_ms <= limit_ms
        for each in commands
    )
    return round(100.0 * good / len(commands), 3)


def _fps(commands: Sequence[CommandRecord]) -> dict[str, float | None]:
    """Return answers a second over the time that each robot asked: the mean and the least of all robots."""
    by_robot: dict[str, list[CommandRecord]] = {}
    for command in commands:
        by_robot.setdefault(command.robot, []).append(command)
    rates = []
    for own in by_robot.values():
        planned = [each.planned for each in own]
        asked_s = max(planned) - min(planned)
        if asked_s > 0:  # n frames span n - 1 intervals
            good = sum(each.code == "ok" for each in own)
            rates.append(good * (len(own) - 1) / len(own) / asked_s)
    if not rates:
        return {"mean": None, "least": None}
    return {"mean": round(float(np.mean(rates)), 3), "least": round(min(rates), 3)}
