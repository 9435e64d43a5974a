"""Judge one fault by the raw records of its run, and hold the figures against the bars they must meet.

Promises to know nothing but the records: who was hit, when, and for how long robots heard nothing, all
come from the commands and events.  A figure that could not be measured misses its bar.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rse_pf.experiments.paper.elasticity_report import crashes
from rse_pf.experiments.results.outages import gap_figures, robots_on
from rse_pf.experiments.results.records import Event, RecordedSample, Records, asked_of, summary_of
from rse_pf.experiments.results.report import CommandRecord, percentiles

__all__ = ["BARS", "evened_out_s", "judge_scenario"]

_NO_LOSS = {"commands/lost": (0, "<="), "commands/twice": (0, "<=")}
_NO_FAILURE = {**_NO_LOSS, "commands/failed": (0, "<=")}

BARS: dict[str, dict[str, tuple[float, str]]] = {
    "kill": {
        **_NO_FAILURE,
        "gap_s/p99": (1.0, "<="),
        "out_of_rotation_s": (1.5, "<="),
        "replaced_in_s": (5.0, "<="),
    },
    "stop": {**_NO_FAILURE, "gap_s/p99": (2.0, "<="), "replaced_in_s": (10.0, "<=")},
    "balancer": {**_NO_FAILURE, "gap_s/p99": (2.0, "<=")},
    "control-plane": {**_NO_FAILURE, "not_adopted": (0, "<="), "adopted": (1, ">=")},
    "wifi": {
        **_NO_LOSS,
        "noticed_s/max": (6.0, "<="),
        "server_noticed_s": (6.0, "<="),
        "first_answer_after_heal_s/p99": (2.0, "<="),
        "stale_as_fresh": (0, "<="),
    },
    "scale-in": {**_NO_FAILURE, "gap_s/p99": (0.5, "<="), "drains": (1, ">=")},
    "roll": {**_NO_FAILURE, "gap_s/p99": (0.5, "<="), "drains": (2, ">=")},
    "scale-out": {**_NO_LOSS, "answered_percent": (99.9, ">="), "evened_out_s": (15.0, "<=")},
    "random": {
        **_NO_LOSS,
        "answered_within_1_s_percent": (99.0, ">="),
        "memory_percent": (5.0, "<="),
        "descriptors_percent": (5.0, "<="),
    },
}
"""What each figure of each scenario must reach; the issue's table."""

_EVEN = 0.2
_CLOCK_S = 0.05  # between the decision to deliver and the time stamp in the record


def judge_scenario(records: Records) -> dict[str, Any]:
    """Return the figures of one fault's run, and each bar with ``held``.

    Raises:
        UsageError: The events do not say what was asked.
    """
    asked = asked_of(records)
    scenario = str(asked["scenario"])
    summary = summary_of(records)
    faults = [event for event in records.events if event["action"] == "fault"]
    found = crashes(records.events)
    replaced = [each["replaced_in_s"] for each in found]
    figures: dict[str, Any] = {
        "scenario": scenario,
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "answered_percent": _percent(records.commands, None),
        "answered_within_1_s_percent": _percent(records.commands, 1000.0),
        "round_trip_ms": summary["round_trip_ms"],
        "gap_s": _gap(records, faults),
        "out_of_rotation_s": _out_of_rotation_s(records.events, faults),
        "crashes": len(found),
        "replaced_in_s": max(replaced) if replaced and None not in replaced else None,
        "drains": sum(event["action"] == "drain-over" for event in records.events),
        "balancer_back_s": _after(records.events, "balancer-gone", "balancer-back"),
        **_scenario_figures(scenario, records, faults),
    }
    bars = BARS.get(scenario, _NO_LOSS)
    return {**figures, "bars": {name: _bar(figures, name, *bar) for name, bar in bars.items()}}


def evened_out_s(readings: Sequence[RecordedSample], since_s: float) -> float | None:
    """Return when, after *since_s*, robots per healthy server came within 20 % of even, for good.

    Seconds after *since_s*; None if they never did.  Source: the issue's table, scale-out row.
    """
    reached = None
    for reading in readings:
        if reading.time < since_s:
            continue
        counts = [each.robots for each in reading.servers if each.state == "healthy"]
        if not sum(counts):
            continue  # nobody is connected any more: nothing to share out
        mean = sum(counts) / len(counts)
        # A whole robot is the finest step there is.
        even = all(abs(count - mean) <= max(_EVEN * mean, 1.0) for count in counts)
        if not even:
            reached = None
        elif reached is None:
            reached = round(reading.time - since_s, 3)
    return reached


def _scenario_figures(scenario: str, records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    if scenario == "control-plane":
        return _adoption(records.events)
    if scenario == "wifi":
        return _cut(records, faults)
    if scenario == "scale-out":
        new = [event for event in records.events if event["action"] == "server-healthy"]
        since = [float(event["time"]) for event in new if faults and event["time"] >= faults[0]["time"]]
        return {"evened_out_s": evened_out_s(records.readings, since[-1]) if since else None}
    if scenario == "random":
        return _growth(records.events)
    return {}


def _gap(records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    """Return the silences of the robots that a fault hit; of several faults, each robot's worst counts."""
    if not faults:
        return {"robots": 0, "p50": None, "p99": None, "max": None}
    everyone = {command.robot for command in records.commands}
    hit: set[str] = set()
    for fault in faults:
        server = fault.get("server")
        hit |= everyone if server is None else robots_on(records.commands, str(server), float(fault["time"]))
    start_s, end_s = float(faults[0]["time"]), float(faults[-1]["time"]) + float(faults[-1]["watch_s"])
    return gap_figures(records.commands, hit, start_s=start_s, end_s=end_s)


def _out_of_rotation_s(events: Sequence[Event], faults: Sequence[Event]) -> float | None:
    """Return the slowest time from a server's fault until the balancer sent nobody to it."""
    times = []
    for fault in faults:
        if fault.get("server") is None:
            continue
        out = [
            float(event["time"]) - float(fault["time"])
            for event in events
            if event["action"] == "server-out"
            and event["server"] == fault["server"]
            and event["time"] >= fault["time"]
        ]
        if not out:
            return None
        times.append(out[0])
    return round(max(times), 3) if times else None


def _adoption(events: Sequence[Event]) -> dict[str, Any]:
    """Compare the processes that ran before the control plane was killed with those it found again."""
    ran: dict[str, set[int]] = {"before": set(), "after": set()}
    for event in events:
        if event["action"] == "processes":
            ran[str(event["when"])] = set(event["pids"])
    return {
        "adopted": len(ran["before"] & ran["after"]),
        "not_adopted": len(ran["before"] - ran["after"]),
        "control_plane_down_s": _after(events, "fault", "control-plane-back"),
    }


def _cut(records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    """Return what a silent link did: who noticed when, and the first answers after it healed."""
    healed = [float(event["time"]) for event in records.events if event["action"] == "healed"]
    noticed: dict[str, float] = {}
    for event in records.events:
        if event["action"] == "link-lost" and faults and event["time"] >= faults[0]["time"]:
            noticed.setdefault(str(event["robot"]), float(event["time"]) - float(faults[0]["time"]))
    first = _first_answers(records.commands, healed[0]) if healed else []
    deadline_s = float(asked_of(records)["deadline_s"]) + _CLOCK_S
    stale = sum(
        each.code == "ok" and each.answered is not None and each.answered - each.sent > deadline_s
        for each in records.commands
    )
    figures = {
        name: percentiles(values) for name, values in (("noticed", list(noticed.values())), ("first", first))
    }
    shown = {name: {key: value[key] for key in ("n", "p50", "p99", "max")} for name, value in figures.items()}
    return {
        "noticed_s": shown["noticed"],
        "server_noticed_s": _after(records.events, "fault", "servers-empty")
        or _emptied_s(records.readings, faults),
        "first_answer_after_heal_s": shown["first"],
        "stale_as_fresh": stale,
    }


def _emptied_s(readings: Sequence[RecordedSample], faults: Sequence[Event]) -> float | None:
    """Return how long after the fault the servers had let go of every robot; None if they never did."""
    for reading in readings:
        after = bool(faults) and reading.time >= faults[0]["time"]
        if after and reading.servers and not any(each.robots for each in reading.servers):
            return round(reading.time - float(faults[0]["time"]), 3)
    return None


def _first_answers(commands: Sequence[CommandRecord], healed_s: float) -> list[float]:
    first: dict[str, float] = {}
    for command in commands:
        if command.code == "ok" and command.answered is not None and command.answered >= healed_s:
            after = command.answered - healed_s
            first[command.robot] = min(first.get(command.robot, after), after)
    return list(first.values())


def _growth(events: Sequence[Event]) -> dict[str, Any]:
    """Return by how much memory and descriptors of a process grew, in percent of the beginning."""
    seen = {str(event["when"]): event for event in events if event["action"] == "resources"}
    if not {"before", "after"} <= set(seen):
        return {"memory_percent": None, "descriptors_percent": None}
    before, after = seen["before"], seen["after"]

    def grown(name: str) -> float:
        then = float(before[name]) / float(before["processes"])
        return round(100.0 * (float(after[name]) / float(after["processes"]) - then) / then, 2)

    return {"memory_percent": grown("memory_bytes"), "descriptors_percent": grown("descriptors")}


def _after(events: Sequence[Event], first: str, then: str) -> float | None:
    """Return the slowest time from an event *first* to the next event *then*."""
    waits, began = [], None
    for event in events:
        if event["action"] == first and began is None:
            began = float(event["time"])
        elif event["action"] == then and began is not None:
            waits.append(float(event["time"]) - began)
            began = None
    return round(max(waits), 3) if waits and began is None else None


def _percent(commands: Sequence[CommandRecord], limit_ms: float | None) -> float | None:
    if not commands:
        return None
    good = {
        (each.robot, each.id)
        for each in commands
        if each.code == "ok"
        and (limit_ms is None or (each.round_trip_ms is not None and each.round_trip_ms <= limit_ms))
    }
    return round(100.0 * len(good) / len({(each.robot, each.id) for each in commands}), 3)


def _bar(figures: Mapping[str, Any], name: str, bar: float, sense: str) -> dict[str, Any]:
    value: Any = figures
    for step in name.split("/"):
        value = value[step]
    held = value is not None and (value <= bar if sense == "<=" else value >= bar)
    return {"value": value, "bar": f"{sense} {bar:g}", "held": held}
