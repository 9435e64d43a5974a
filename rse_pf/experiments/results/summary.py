"""Figures that every report holds: counts of commands, percentiles, and the means that the paper gives.

Pure functions over `rse_pf.experiments.results.records`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from rse_pf.experiments.results.records import CommandRecord, Records

__all__ = ["PAPER", "ROUND_TRIP_PARTS", "answered_percent", "percentiles", "summarise", "summary_of"]

PAPER = {"round_trip_ms": 156.36, "compute_ms": 29.82, "payload_bytes": 10_000, "fps_per_robot": 5.0}
"""The paper's Sect. 6.1 and 6.2: means over a hundred robots, Shenzhen to Seoul."""
ROUND_TRIP_PARTS = ("up_ms", "queue_ms", "compute_ms", "down_ms")
"""Parts of a round trip; the rest is spent in the robot itself (and in a late load generator)."""


def summarise(commands: Sequence[CommandRecord]) -> dict[str, Any]:
    """Return counts and percentiles of a run.

    *Answered* means a result from the cloud or the robot; *lost* means no final answer at all;
    *twice* counts commands with more than one final answer.
    """
    finals = Counter((command.robot, command.id) for command in commands if command.code)
    failures = Counter(command.code for command in commands if command.code not in ("", "ok"))
    answered = [command for command in commands if command.code == "ok"]
    return {
        "commands": {
            "sent": len({(command.robot, command.id) for command in commands}),
            "answered": len({(command.robot, command.id) for command in answered}),
            "failed": sum(failures.values()),
            "lost": len({(c.robot, c.id) for c in commands if (c.robot, c.id) not in finals}),
            "twice": sum(count > 1 for count in finals.values()),
            "answered_by_robot": sum(command.source == "robot" for command in answered),
        },
        "failures_by_code": dict(failures),
        "payload_bytes": _median_max([c.payload_bytes for c in commands if c.payload_bytes]),
        **{
            name: percentiles([value for c in answered if (value := getattr(c, name)) is not None])
            for name in ("round_trip_ms", *ROUND_TRIP_PARTS)
        },
        "commands_by_server": dict(Counter(command.server for command in answered)),
    }


def summary_of(records: Records) -> dict[str, Any]:
    """Return `summarise` of the commands, with duplicates and wrong poses as the load generator counted them.

    A duplicate answer has no row of its own; the generator counts those that reached a caller.
    """
    summary = summarise(records.commands)
    generator = [event for event in records.events if event["action"] == "generator"]
    duplicates = sum(int(event.get("twice", 0)) for event in generator)
    summary["commands"]["twice"] = max(summary["commands"]["twice"], duplicates)
    summary["wrong_poses"] = sum(int(event.get("wrong_poses", 0)) for event in generator)
    return summary


def answered_percent(commands: Sequence[CommandRecord], within_ms: float | None = None) -> float | None:
    """Return the share of commands with a result (at most *within_ms* after the plan); None without any."""
    if not commands:
        return None
    good = {
        (each.robot, each.id)
        for each in commands
        if each.code == "ok"
        and (within_ms is None or (each.round_trip_ms is not None and each.round_trip_ms <= within_ms))
    }
    return round(100.0 * len(good) / len({(each.robot, each.id) for each in commands}), 3)


def percentiles(values: Sequence[float]) -> dict[str, float | int | None]:
    """Return n, mean, p50, p95, p99 and the maximum, rounded to three digits."""
    if not values:
        return {"n": 0, "mean": None, "p50": None, "p95": None, "p99": None, "max": None}
    p50, p95, p99, largest = np.percentile(values, [50, 95, 99, 100])
    named = {"mean": float(np.mean(values)), "p50": p50, "p95": p95, "p99": p99, "max": largest}
    return {"n": len(values), **{name: round(float(value), 3) for name, value in named.items()}}


def _median_max(values: Sequence[int]) -> dict[str, int | None]:
    if not values:
        return {"median": None, "max": None}
    return {"median": int(np.median(values)), "max": max(values)}
