"""Judge an elasticity run by its raw records: the paper's Fig. 8 as figures, and the law behind it.

The law: no server is added for being busy unless the required whole periods before it were busy, in the
monitor's own readings.  Promises to know nothing but the records, so that anybody can judge again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rse_pf.experiments.results.records import Event, RecordedSample, Records, asked_of, summary_of
from rse_pf.experiments.results.report import CommandRecord, summarise

__all__ = ["busy_periods_before", "crashes", "judge_elasticity", "unjustified_scale_outs"]

_FEWER = "fewer than"
"""How the policy's reason begins when servers are missing, not busy."""
_ROUNDING_PERCENT = 0.01


def judge_elasticity(records: Records) -> dict[str, Any]:
    """Return the figures of an elasticity run; ``replaced_in_s`` is the slowest, None if one never was.

    Raises:
        UsageError: The events do not begin with what was asked.
    """
    asked, readings = asked_of(records), records.readings
    summary = summary_of(records)
    found = crashes(records.events)
    replaced = [each["replaced_in_s"] for each in found]
    whole = [value for value in replaced if value is not None]
    return {
        "scale_outs": len(_scale_outs(records.events)),
        "scale_ins": sum(event["action"] == "shrink" for event in records.events),
        "min_servers": asked["min_servers"],
        "max_servers": max((reading.healthy_servers for reading in readings), default=0),
        "final_servers": readings[-1].healthy_servers if readings else 0,
        "crashes": len(found),
        "replaced_in_s": max(whole) if whole and len(whole) == len(replaced) else None,
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "round_trip_ms": summary["round_trip_ms"],
        "phases": _phases(records),
        "queue_ms": summary["queue_ms"],
        "compute_ms": summary["compute_ms"],
        "commands_by_server": summary["commands_by_server"],
        "scale_events": _scale_events(records.events),
        "crash_list": found,
        "cpu_percent_series": [
            [round(reading.time, 3), round(reading.cpu_percent, 2)]
            for reading in readings
            if reading.cpu_percent is not None
        ],
        "healthy_servers_series": [[round(reading.time, 3), reading.healthy_servers] for reading in readings],
        "robots_per_server_series": [
            [round(reading.time, 3), {each.server: each.robots for each in reading.servers}]
            for reading in readings
        ],
    }


def crashes(events: Sequence[Event]) -> list[dict[str, Any]]:
    """Return every server that ended without a drain, and how long until a new one served in its place."""
    leaving = {event["server"] for event in events if event["action"] == "drain-start"}
    launched = {event["server"]: event["time"] for event in events if event["action"] == "server-launched"}
    taken: set[str] = set()
    found = []
    for event in events:
        if event["action"] != "server-gone" or event["server"] in leaving:
            continue
        began = _fault_before(events, event)
        healthy = [
            later
            for later in events
            if later["action"] == "server-healthy"
            and later["time"] >= began
            and launched.get(later["server"], -math.inf) >= began
            and later["server"] not in taken
        ]
        if healthy:
            taken.add(healthy[0]["server"])
        found.append(
            {
                "server": event["server"],
                "pid": event.get("pid"),
                "time": round(began, 3),
                "by": healthy[0]["server"] if healthy else None,
                "replaced_in_s": round(healthy[0]["time"] - began, 3) if healthy else None,
            }
        )
    return found


def busy_periods_before(
    readings: Sequence[RecordedSample], time_s: float, *, origin_s: float, period_s: float, periods: int
) -> list[float | None]:
    """Return the mean CPU of the last whole *periods* before *time_s*, oldest first; None without a reading.

    Periods begin at multiples of *period_s* of the monitor's clock, which stood at *origin_s* when the run
    began; a reading speaks for the time since the one before it.
    """
    sums: dict[int, list[float]] = {}
    before = None
    for reading in readings:
        since = reading.time - (before if before is not None else reading.time)
        before = reading.time
        if reading.cpu_percent is None:
            continue
        period = math.floor((reading.time - since / 2 + origin_s) / period_s)
        seconds, weighted = sums.setdefault(period, [0.0, 0.0])
        sums[period] = [seconds + since, weighted + since * reading.cpu_percent]
    ended = math.floor((time_s + origin_s) / period_s + 1e-6)
    return [
        sums[each][1] / sums[each][0] if each in sums and sums[each][0] > 0 else None
        for each in range(ended - periods, ended)
    ]


def unjustified_scale_outs(records: Records) -> list[str]:
    """Return a line for each scale-out that the readings before it do not justify; empty is lawful."""
    asked = asked_of(records)
    wrong = []
    for event in _scale_outs(records.events):
        if not str(event.get("reason", "")).startswith("CPU"):
            continue
        seen = busy_periods_before(
            records.readings,
            float(event["time"]),
            origin_s=float(asked["origin_s"]),
            period_s=float(asked["period_s"]),
            periods=int(asked["busy_periods"]),
        )
        limit = float(asked["busy_cpu_percent"])
        if any(value is None or value < limit - _ROUNDING_PERCENT for value in seen):
            told = ", ".join("none" if value is None else f"{value:.1f} %" for value in seen)
            wrong.append(f"at {event['time']:.2f} s: {told} before it, {limit:g} % is required")
    return wrong


def _scale_outs(events: Sequence[Event]) -> list[Event]:
    """Return the growths that the load asked for, not those that fill a gap."""
    return [
        event
        for event in events
        if event["action"] == "grow" and not str(event.get("reason", "")).startswith(_FEWER)
    ]


def _scale_events(events: Sequence[Event]) -> list[dict[str, Any]]:
    kinds = ("grow", "shrink", "replace")
    return [
        {
            "time": round(event["time"], 3),
            "action": event["action"],
            "servers": event.get("servers"),
            "reason": event.get("reason", ""),
        }
        for event in events
        if event["action"] in kinds
    ]


def _fault_before(events: Sequence[Event], gone: Event) -> float:
    """Return when the fault that ended this server was made; without one, when it ended."""
    times = [
        float(event["time"])
        for event in events
        if event["action"] == "fault"
        and event.get("server") == gone["server"]
        and event["time"] <= gone["time"]
    ]
    return times[-1] if times else float(gone["time"])


def _phases(records: Records) -> dict[str, Any]:
    """Return the round trips and failures of each phase of the run, by the time a command was planned."""
    marks = [event for event in records.events if event["action"] == "phase"]
    figures = {}
    ends = [*(float(mark["time"]) for mark in marks[1:]), math.inf]
    for mark, end in zip(marks, ends, strict=False):
        within = [each for each in records.commands if float(mark["time"]) <= each.planned < end]
        if within:
            figures[str(mark["phase"])] = _phase(within)
    return figures


def _phase(commands: Sequence[CommandRecord]) -> dict[str, Any]:
    summary: Mapping[str, Any] = summarise(commands)
    return {
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "round_trip_ms": summary["round_trip_ms"],
    }
