"""Figures that every report holds: counts of commands, percentiles, and the means that the paper states.

The functions compute figures from `rse_pf.extensions.experiments.results.records` only.  An outage is the
time around a fault in which a robot received no answer.  A fault of a server affects the robots whose last
answer before the fault came from that server; a robot that received no further answer counts as well.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from rse_pf.extensions.experiments.results.records import CommandRecord, Records

__all__ = [
    "PAPER",
    "ROUND_TRIP_PARTS",
    "frame_rates",
    "longest_outages",
    "outage_figures",
    "percent_answered",
    "percentiles",
    "robots_on",
    "summarise",
    "summary_of",
]

PAPER = {"round_trip_ms": 156.36, "compute_ms": 29.82, "payload_bytes": 10_000, "fps_per_robot": 5.0}
"""Means in the paper's Sect. 6.1 and 6.2, over a hundred robots between Shenzhen and Seoul."""
ROUND_TRIP_PARTS = ("up_ms", "queue_ms", "compute_ms", "down_ms")
"""Parts of a round trip outside the robot; the rest is the time in the robot and the lateness of the load
generator."""


def summarise(commands: Sequence[CommandRecord]) -> dict[str, Any]:
    """Return the counts of commands, and percentiles of round trips and their parts.

    ``answered`` counts results of the cloud or of the robot itself, ``lost`` commands without a final answer,
    ``twice`` commands with more than one, and ``answered_by_robot`` results of the robot itself.
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
    """Return `summarise` of the commands, with the load generator's counts of duplicates and wrong poses.

    A duplicate answer has no row in the records; the load generator counts those that reached the caller.
    """
    summary = summarise(records.commands)
    generator = [event for event in records.events if event["action"] == "generator"]
    duplicates = sum(int(event.get("twice", 0)) for event in generator)
    summary["commands"]["twice"] = max(summary["commands"]["twice"], duplicates)
    summary["wrong_poses"] = sum(int(event.get("wrong_poses", 0)) for event in generator)
    return summary


def percent_answered(commands: Sequence[CommandRecord], within_ms: float | None = None) -> float | None:
    """Return the percentage of commands that have a result; None if there are no commands.

    With *within_ms* only results whose round trip is at most that long count.
    """
    if not commands:
        return None
    good = {
        (command.robot, command.id)
        for command in commands
        if command.code == "ok"
        and (within_ms is None or (command.round_trip_ms is not None and command.round_trip_ms <= within_ms))
    }
    return round(100.0 * len(good) / len({(command.robot, command.id) for command in commands}), 3)


def percentiles(values: Sequence[float]) -> dict[str, float | int | None]:
    """Return n, mean, p50, p95, p99 and maximum of *values*, rounded to three decimals.

    Without values, n is 0 and all others are None.
    """
    if not values:
        return {"n": 0, "mean": None, "p50": None, "p95": None, "p99": None, "max": None}
    p50, p95, p99, largest = np.percentile(values, [50, 95, 99, 100])
    named = {"mean": float(np.mean(values)), "p50": p50, "p95": p95, "p99": p99, "max": largest}
    return {"n": len(values), **{name: round(float(value), 3) for name, value in named.items()}}


def frame_rates(commands: Sequence[CommandRecord]) -> list[float]:
    """Return the answers per second of each robot that sent two commands or more, while it sent them."""
    by_robot: dict[str, list[CommandRecord]] = defaultdict(list)
    for command in commands:
        by_robot[command.robot].append(command)
    rates = []
    for own in by_robot.values():
        planned = [record.planned for record in own]
        sending_s = max(planned) - min(planned)
        if sending_s > 0:  # n frames span n - 1 intervals
            answered = sum(record.code == "ok" for record in own)
            rates.append(answered * (len(own) - 1) / len(own) / sending_s)
    return rates


def robots_on(commands: Sequence[CommandRecord], server: str, at_s: float) -> set[str]:
    """Return the robots whose last answer before *at_s* came from *server*."""
    last: dict[str, tuple[float, str]] = {}
    for command in commands:
        if command.code == "ok" and command.answered is not None and command.answered <= at_s:
            last[command.robot] = max(last.get(command.robot, (-1.0, "")), (command.answered, command.server))
    return {robot for robot, (_, name) in last.items() if name == server}


def longest_outages(
    commands: Sequence[CommandRecord],
    robots: Collection[str],
    *,
    start_s: float,
    end_s: float,
) -> dict[str, float]:
    """Return for each robot the longest time (s) between two answers that overlaps ``[start_s, end_s]``.

    If a robot sent commands after its last answer, the time from that answer to its last command counts as
    well.

    Args:
        commands: All commands of the run.
        robots: Names of the robots for which the time is returned.
        start_s: Time of the fault, seconds since the start of the run.
        end_s: End of the time in which outages are attributed to the fault, seconds since the start of the
            run.
    """
    times: dict[str, list[float]] = defaultdict(list)
    planned: dict[str, float] = defaultdict(float)
    for command in commands:
        if command.robot in robots:
            planned[command.robot] = max(planned[command.robot], command.planned)
            if command.code == "ok" and command.answered is not None:
                times[command.robot].append(command.answered)
    outages = {}
    for robot in robots:
        moments = sorted(times[robot])
        if moments and planned[robot] > moments[-1]:
            moments.append(planned[robot])
        if not moments:
            moments = [start_s, max(planned[robot], start_s)]
        outages[robot] = max(
            (
                later - earlier
                for earlier, later in pairwise(moments)
                if later >= start_s and earlier <= end_s
            ),
            default=0.0,
        )
    return outages


def outage_figures(
    commands: Sequence[CommandRecord], robots: Collection[str], *, start_s: float, end_s: float
) -> dict[str, Any]:
    """Return the number of *robots*, and p50, p99 and maximum of their `longest_outages` in seconds."""
    outages = longest_outages(commands, robots, start_s=start_s, end_s=end_s)
    figures = percentiles(list(outages.values()))
    return {"robots": len(outages), "p50": figures["p50"], "p99": figures["p99"], "max": figures["max"]}


def _median_max(values: Sequence[int]) -> dict[str, int | None]:
    if not values:
        return {"median": None, "max": None}
    return {"median": int(np.median(values)), "max": max(values)}
