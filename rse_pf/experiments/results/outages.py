"""Silence around a fault: for how long the robots of the server that was hit went without an answer.

From the records alone.  Promises to judge only robots whose last answer before the fault came from that
server, and to count a robot that never heard again until the run's end, not to leave it out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from itertools import pairwise
from typing import Any

from rse_pf.experiments.results.report import CommandRecord, percentiles

__all__ = ["gap_figures", "longest_silences", "robots_on"]


def robots_on(commands: Iterable[CommandRecord], server: str, at_s: float) -> set[str]:
    """Return the robots whose last answer before *at_s* came from *server*."""
    last: dict[str, tuple[float, str]] = {}
    for command in _answered(commands):
        assert command.answered is not None
        if command.answered <= at_s:
            last[command.robot] = max(last.get(command.robot, (-1.0, "")), (command.answered, command.server))
    return {robot for robot, (_, name) in last.items() if name == server}


def longest_silences(
    commands: Sequence[CommandRecord],
    robots: Collection[str],
    *,
    start_s: float,
    end_s: float,
) -> dict[str, float]:
    """Return each robot's longest time between two answers that touches ``[start_s, end_s]``, in seconds.

    A robot that asked on, but heard nothing more, was silent until the last time it asked; one that
    left in peace was not.

    Args:
        commands: All commands of the run.
        robots: Whom to judge.
        start_s: The fault, seconds since the run began.
        end_s: When its consequences must be over.
    """
    times: dict[str, list[float]] = defaultdict(list)
    planned: dict[str, float] = defaultdict(float)
    for command in commands:
        if command.robot in robots:
            planned[command.robot] = max(planned[command.robot], command.planned)
            if command.code == "ok" and command.answered is not None:
                times[command.robot].append(command.answered)
    silences = {}
    for robot in robots:
        moments = sorted(times[robot])
        if moments and planned[robot] > moments[-1]:
            moments.append(planned[robot])
        if not moments:
            moments = [start_s, max(planned[robot], start_s)]
        silences[robot] = max(
            (
                later - earlier
                for earlier, later in pairwise(moments)
                if later >= start_s and earlier <= end_s
            ),
            default=0.0,
        )
    return silences


def gap_figures(
    commands: Sequence[CommandRecord], robots: Collection[str], *, start_s: float, end_s: float
) -> dict[str, Any]:
    """Return how many robots were hit, and p50, p99 and the largest of their silences in seconds."""
    silences = longest_silences(commands, robots, start_s=start_s, end_s=end_s)
    figures = percentiles(list(silences.values()))
    return {"robots": len(silences), "p50": figures["p50"], "p99": figures["p99"], "max": figures["max"]}


def _answered(commands: Iterable[CommandRecord]) -> Iterable[CommandRecord]:
    return (command for command in commands if command.code == "ok" and command.answered is not None)
