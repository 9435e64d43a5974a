"""The figures of a live map during a fault, from the records of the run and the log of the map.

The log in the platform's object store is replayed from its first entry and says which keyframes the map
holds. The records of the robots say which keyframes the map server has acknowledged, and when.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from rse_pf.extensions.experiments.results.bars import missed_bars, with_bars
from rse_pf.extensions.experiments.results.live_error import (
    LiveDrive,
    live_figures,
    read_live_drives,
    read_live_map,
)
from rse_pf.extensions.experiments.results.log_replay import LoggedMap, read_log
from rse_pf.extensions.experiments.results.markdown import number, slashed
from rse_pf.extensions.experiments.results.records import (
    CommandRecord,
    Event,
    Records,
    parameters_of,
    robot_names,
)
from rse_pf.extensions.experiments.results.summary import summarise

__all__ = ["LIVE_FAULT_BARS", "fault_rows", "live_fault_figures"]

# Names of the faults after which another server must serve the map.
_FAULTS_WITH_NEW_SERVER = {"kill", "stop", "drain", "roll"}
# Targets of every fault: nothing that was acknowledged is lost, and the replayed log gives the same map.
_NO_LOSS = {
    "keyframes/lost": (0.0, "<="),
    "keyframes/twice": (0.0, "<="),
    "keyframes/out_of_order": (0.0, "<="),
    "keyframes/waiting": (0.0, "<="),
    "frames_lost": (0.0, "<="),
    "commands/lost": (0.0, "<="),
    "replay_equal": (1.0, ">="),
}
LIVE_FAULT_BARS: dict[str, dict[str, tuple[float, str]]] = {
    "none": _NO_LOSS,
    **{
        name: {**_NO_LOSS, "new_owner_s": (3.0, "<="), "owners": (2.0, ">=")}
        for name in sorted(_FAULTS_WITH_NEW_SERVER)
    },
    "store": _NO_LOSS,
    "wifi": {**_NO_LOSS, "keyframes/ahead_of_poses": (0.0, "<=")},
}
"""The targets of each fault: limit and comparison that must hold, by the path of the figure."""


def live_fault_figures(records: Records) -> dict[str, Any]:
    """Return the figures of one run, and for each target whether the run met it (``held``).

    Raises:
        UsageError: The events do not hold the parameters of the run, or a record cannot be read.
    """
    parameters = parameters_of(records)
    fault = str(parameters["fault"])
    drives = read_live_drives(records.folder, robot_names(int(parameters["robots"])))
    final: Mapping[str, Any] = next((event for event in records.events if event["action"] == "final-map"), {})
    logged = read_log(records.folder / "platform" / "objects", int(final.get("position", 0)))
    started = next(
        (float(event["time"]) for event in records.events if event["action"] == "robots-start"), 0.0
    )
    after = next(
        (float(event["after_s"]) for event in records.events if event["action"] == "robots-start"), 0.0
    )
    summary = summarise(records.commands)
    figures: dict[str, Any] = {
        "fault": fault,
        "at_s": _fault_at_s(records.events, started + after),
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "round_trip_ms": summary["round_trip_ms"],
        "keyframes": {
            **_keyframes(drives, logged),
            "ahead_of_poses": sum(_ahead(drive, records.commands) for drive in drives),
        },
        "frames_lost": sum(frame["T_odom"] is None for drive in drives for frame in drive.frames),
        "new_owner_s": _new_owner_s(records.events),
        "owners": logged.epochs,
        "unacknowledged_s": _longest_wait_s(drives),
        "replay_equal": int(bool(final.get("digest")) and logged.digest == final["digest"]),
        "live": live_figures(drives, read_live_map(records.folder)),
    }
    bars = LIVE_FAULT_BARS.get(fault, _NO_LOSS)
    return with_bars(figures, bars)


def fault_rows(runs: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of a table with the main figures of *runs*: first the head, then a row for each run.

    After the ATE of a run stands its difference to the mean ATE of the runs without a fault, if there are
    some.
    """
    undisturbed = [
        one_run["live"]["final_ate_cm"]
        for one_run in runs.values()
        if one_run["fault"] == "none" and one_run["live"]["final_ate_cm"] is not None
    ]
    rows = [list(_TABLE_HEAD)]
    for name, run in runs.items():
        tally, live, ate = run["keyframes"], run["live"], run["live"]["final_ate_cm"]
        than = (
            f" ({ate - sum(undisturbed) / len(undisturbed):+.2f})" if undisturbed and ate is not None else ""
        )
        missed = missed_bars(run)
        rows.append(
            [
                name,
                number(run["at_s"]),
                f"{tally['acknowledged']} / {tally['in_log']}",
                f"{tally['lost']} / {tally['twice']} / {tally['out_of_order']} / {tally['ahead_of_poses']}",
                str(run["frames_lost"]),
                f"{number(run['new_owner_s'])} ({run['owners']})",
                number(run["unacknowledged_s"]),
                "yes" if run["replay_equal"] else "NO",
                f"{number(ate)}{than}",
                f"{live['joined']}, {number(live['aligned_percent'])}",
                slashed(live["correction_ms"], "p50", "p99"),
                slashed(run["round_trip_ms"], "p50", "p99"),
                f"missed: {', '.join(missed)}" if missed else "all met",
            ]
        )
    return rows


# The head of the table of `fault_rows`.
_TABLE_HEAD = (
    "fault", "at s", "keyframes acknowledged / in the log", "lost / twice / out of order / ahead of poses",
    "frames lost", "new owner after s (owners)", "longest acknowledgement s", "replay equal",
    "ATE cm (against undisturbed)", "joined, aligned %", "correction ms p50 / p99", "pose ms p50 / p99",
    "targets",
)  # fmt: skip


def _keyframes(drives: Sequence[LiveDrive], logged: LoggedMap) -> dict[str, int]:
    """Return counts of keyframes, by comparing the robots' records with the log of the map.

    ``made``, ``acknowledged`` and ``waiting`` (never acknowledged) are counted by the robots, ``in_log`` in
    the log.  ``lost`` counts acknowledged keyframes that the log lacks.  ``twice`` is the sum of three counts
    of repetitions within a robot: of numbers in the log, of time stamps in the log, and of numbers among the
    acknowledged keyframes.  ``out_of_order`` counts keyframes whose number and time stamp are not after
    those of the robot's previous keyframe in the log.
    """
    lost = twice = out_of_order = 0
    for drive in drives:
        held = [(number, stamp) for name, number, stamp in logged.keyframes if name == drive.name]
        numbers = Counter(number for number, _ in held)
        stamps = Counter(stamp for _, stamp in held)
        lost += sum(keyframe["number"] not in numbers for keyframe in drive.keyframes)
        twice += sum(count - 1 for count in numbers.values()) + sum(count - 1 for count in stamps.values())
        twice += len(drive.keyframes) - len({keyframe["number"] for keyframe in drive.keyframes})
        out_of_order += sum(after <= before for before, after in pairwise(held))
    return {
        "made": sum(int(drive.end["keyframes"]) for drive in drives),
        "acknowledged": sum(len(drive.keyframes) for drive in drives),
        "in_log": len(logged.keyframes),
        "waiting": sum(int(drive.end["keyframes_waiting"]) for drive in drives),
        "lost": lost,
        "twice": twice,
        "out_of_order": out_of_order,
    }


def _ahead(drive: LiveDrive, commands: Sequence[CommandRecord]) -> int:
    """Return how many keyframes the robot sent while it waited for the answer to a pose request.

    The wait counts for at most 1 s after the request: keyframes may be sent after that.
    """
    asked = sorted(
        (command.sent, min(command.answered or math.inf, command.sent + 1.0))
        for command in commands
        if command.robot == drive.name
    )
    return sum(any(begin < keyframe["sent"] < end for begin, end in asked) for keyframe in drive.keyframes)


def _fault_at_s(events: Sequence[Event], started_s: float) -> float | None:
    at = next((float(event["time"]) for event in events if event["action"] == "fault"), None)
    return None if at is None else round(at - started_s, 3)


def _new_owner_s(events: Sequence[Event]) -> float | None:
    """Return the longest time (s) without a map server; None if the map server never changed.

    The time lasts from the fault, or from the release of the lease if the map server released it, until the
    next map server serves.
    """
    fault = next((entry for entry in events if entry["action"] == "fault" and "owner" in entry), None)
    if fault is None:
        return None
    waits, owner, gone_s = [], str(fault["owner"]), float(fault["time"])
    for event in events:
        if event["action"] != "lease" or event["time"] < fault["time"]:
            continue
        if event["state"] == "released" and event["owner"] == owner:
            gone_s = float(event["time"])
        elif event["state"] == "serving" and event["owner"] != owner:
            waits.append(float(event["time"]) - gone_s)
            owner, gone_s = str(event["owner"]), float(event["time"])
    return round(max(waits), 3) if waits else None


def _longest_wait_s(drives: Sequence[LiveDrive]) -> float | None:
    """Return the longest time (s) from sending a keyframe to its acknowledgement; None without a keyframe."""
    waits = [
        float(keyframe["kept"]) - float(keyframe["sent"]) for drive in drives for keyframe in drive.keyframes
    ]
    return round(max(waits), 3) if waits else None
