"""Outages of robots around a fault: for how long the robots of the affected server had no answer.

Computed from the records alone.  Only robots whose last answer before the fault came from the affected
server count; a robot that got no further answer until the end of the run counts as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

from rse_pf.experiments.results.records import CommandRecord
from rse_pf.experiments.results.summary import percentiles

__all__ = ["longest_outages", "outage_figures", "robots_on"]


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
    """Return the longest time between two answers of each robot that overlaps ``[start_s, end_s]``.

    In seconds.  For a robot that sent commands after its last answer, the outage ends with its last
    command; for a robot that stopped sending there is none.

    Args:
        commands: All commands of the run.
        robots: The robots to look at.
        start_s: Time of the fault, seconds since the start of the run.
        end_s: When its consequences must be over.
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
    """Return how many robots were affected, and p50, p99 and maximum of their outages in seconds."""
    outages = longest_outages(commands, robots, start_s=start_s, end_s=end_s)
    figures = percentiles(list(outages.values()))
    return {"robots": len(outages), "p50": figures["p50"], "p99": figures["p99"], "max": figures["max"]}
