"""Figures and report of an elasticity run (the paper's Fig. 8), computed from its raw records alone.

`unjustified_scale_outs` checks the policy: no server is added for load unless the mean CPU of the required
whole periods before it was above the limit, by the samples of the monitor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rse_pf.experiments.results.markdown import about_run, failures, number, page, slashed, table, three
from rse_pf.experiments.results.records import Event, Records, parameters_of
from rse_pf.experiments.results.summary import summarise, summary_of
from rse_pf.local.control.monitor import MonitorSample

__all__ = [
    "busy_periods_before",
    "crashes",
    "elasticity_figures",
    "elasticity_page",
    "slowest_replacement_s",
    "unjustified_scale_outs",
]

_FEWER = "fewer than"
"""The reason of the policy begins so when servers are missing, not when they are busy."""
_ROUNDING_PERCENT = 0.01


def elasticity_figures(records: Records) -> dict[str, Any]:
    """Return the figures of an elasticity run.

    Raises:
        UsageError: The events do not hold the parameters of the run.
    """
    parameters, samples = parameters_of(records), records.samples
    summary = summary_of(records)
    found = crashes(records.events)
    return {
        "scale_outs": len(_scale_outs(records.events)),
        "scale_ins": sum(event["action"] == "shrink" for event in records.events),
        "min_servers": parameters["min_servers"],
        "max_servers": max((sample.healthy_servers for sample in samples), default=0),
        "final_servers": samples[-1].healthy_servers if samples else 0,
        "crashes": len(found),
        "replaced_in_s": slowest_replacement_s(found),
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "round_trip_ms": summary["round_trip_ms"],
        "phases": _phases(records),
        "queue_ms": summary["queue_ms"],
        "compute_ms": summary["compute_ms"],
        "commands_by_server": summary["commands_by_server"],
        "scale_events": [
            {
                "time": round(event["time"], 3),
                "action": event["action"],
                "servers": event.get("servers"),
                "reason": event.get("reason", ""),
            }
            for event in records.events
            if event["action"] in ("grow", "shrink", "replace")
        ],
        "crash_list": found,
        "cpu_percent_series": [
            [round(sample.time, 3), round(sample.cpu_percent, 2)]
            for sample in samples
            if sample.cpu_percent is not None
        ],
        "healthy_servers_series": [[round(sample.time, 3), sample.healthy_servers] for sample in samples],
        "robots_per_server_series": [
            [round(sample.time, 3), {each.name: each.robots for each in sample.servers}] for sample in samples
        ],
    }


def elasticity_page(report: Mapping[str, Any], runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return ``report.md``, with a column for each of *runs*."""
    asked, cost = report["asked"], report.get("cost")
    cells: dict[str, Callable[[Mapping[str, Any]], Any]] = {
        "scale-outs / scale-ins": lambda run: slashed(run, "scale_outs", "scale_ins"),
        "servers: minimum / most / at the end": lambda run: slashed(
            run, "min_servers", "max_servers", "final_servers"
        ),
        "crashes (kill -9)": lambda run: run["crashes"],
        "replacement healthy after, s": lambda run: number(run["replaced_in_s"]),
        "commands sent / answered": lambda run: slashed(run["commands"], "sent", "answered"),
        "failed, by code": failures,
        "lost / answered twice": lambda run: slashed(run["commands"], "lost", "twice"),
        "round trip p50 / p95 / p99 ms": lambda run: three(run["round_trip_ms"]),
        **{
            f"  while {phase}: p50 / p95 / p99 ms": partial(_phase_round_trip, phase)
            for phase in ("joining", "full", "crash")
        },
    }
    measured = f", because one command costs {1000 * cost['command_s']:.2f} ms of CPU" if cost else ""
    return page(
        "# RSE-PF experiment: elasticity (the paper's Fig. 8)",
        f"{asked['robots']} robots x {asked['fps']:g} fps; time compressed {asked['speed']:g}x "
        "(joining interval, the policy's periods, idle time and warm-up; nothing else).",
        f"Each server emulates {report['size']:g} cores{measured}.",
        table(
            ["figure", *(name or "here" for name in runs)],
            [[what, *(cell(run) for run in runs.values())] for what, cell in cells.items()],
        ),
        "The paper: a robot every 20 s up to a hundred, scale-out above 70 % CPU, scale-in after "
        "5 minutes idle, one crash; it gives no figures for p99, recovery or loss.",
        about_run(report),
    )


def _phase_round_trip(phase: str, run: Mapping[str, Any]) -> str:
    return three(run["phases"].get(phase, {}).get("round_trip_ms", {}))


def crashes(events: Sequence[Event]) -> list[dict[str, Any]]:
    """Return every server that ended without a drain, and the time until a new one replaced it."""
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


def slowest_replacement_s(found: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the longest replacement time of `crashes`; None if there is none or one was never replaced."""
    times = [each["replaced_in_s"] for each in found]
    return max(times) if times and None not in times else None


def busy_periods_before(
    samples: Sequence[MonitorSample], time_s: float, *, origin_s: float, period_s: float, periods: int
) -> list[float | None]:
    """Return the mean CPU of the last whole *periods* before *time_s*, oldest first; None without a sample.

    Periods begin at multiples of *period_s* of the monitor's clock, which was *origin_s* at the start of the
    run; a sample covers the time since the one before it.
    """
    sums: dict[int, list[float]] = {}
    before = None
    for sample in samples:
        since = sample.time - (before if before is not None else sample.time)
        before = sample.time
        if sample.cpu_percent is None:
            continue
        period = math.floor((sample.time - since / 2 + origin_s) / period_s)
        seconds, weighted = sums.setdefault(period, [0.0, 0.0])
        sums[period] = [seconds + since, weighted + since * sample.cpu_percent]
    ended = math.floor((time_s + origin_s) / period_s + 1e-6)
    return [
        sums[each][1] / sums[each][0] if each in sums and sums[each][0] > 0 else None
        for each in range(ended - periods, ended)
    ]


def unjustified_scale_outs(records: Records) -> list[str]:
    """Return a line for each scale-out for load that the samples before it do not justify."""
    parameters = parameters_of(records)
    wrong = []
    for event in _scale_outs(records.events):
        if not str(event.get("reason", "")).startswith("CPU"):
            continue
        seen = busy_periods_before(
            records.samples,
            float(event["time"]),
            origin_s=float(parameters["origin_s"]),
            period_s=float(parameters["period_s"]),
            periods=int(parameters["busy_periods"]),
        )
        limit = float(parameters["busy_cpu_percent"])
        if any(value is None or value < limit - _ROUNDING_PERCENT for value in seen):
            values = ", ".join("none" if value is None else f"{value:.1f} %" for value in seen)
            wrong.append(f"at {event['time']:.2f} s: {values} before it, {limit:g} % is required")
    return wrong


def _scale_outs(events: Sequence[Event]) -> list[Event]:
    """Return the scale-outs for load, not those that replace missing servers."""
    return [
        event
        for event in events
        if event["action"] == "grow" and not str(event.get("reason", "")).startswith(_FEWER)
    ]


def _fault_before(events: Sequence[Event], gone: Event) -> float:
    """Return the time of the fault that ended this server; without one, the time of its end."""
    times = [
        float(event["time"])
        for event in events
        if event["action"] == "fault"
        and event.get("server") == gone["server"]
        and event["time"] <= gone["time"]
    ]
    return times[-1] if times else float(gone["time"])


def _phases(records: Records) -> dict[str, Any]:
    """Return the counts, failures and round trips of each phase, by the planned time of the commands."""
    marks = [event for event in records.events if event["action"] == "phase"]
    figures = {}
    ends = [*(float(mark["time"]) for mark in marks[1:]), math.inf]
    for mark, end in zip(marks, ends, strict=False):
        within = [each for each in records.commands if float(mark["time"]) <= each.planned < end]
        if within:
            summary = summarise(within)
            names = ("commands", "failures_by_code", "round_trip_ms")
            figures[str(mark["phase"])] = {name: summary[name] for name in names}
    return figures
