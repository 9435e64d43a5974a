"""Answers of the owner of a live map, as plain values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rse_pf.identity import RobotId
from rse_pf.live_map.events import matrix_bytes
from rse_pf.maps.registry import MapRecord
from rse_pf.server.live_map.owner.lease import LeaseRecord
from rse_pf.server.live_map.owner.state import MapState, upper_triangle

__all__ = ["paths_reply", "relocalise_reply", "show_missing", "show_reply", "version_reply"]

_MAX_PATH_POINTS = 4_000
"""About 100 kB of JSON, of 256 that a message may have."""


def relocalise_reply(found: Any, version: int) -> dict[str, Any]:
    """Return the answer to a robot that asked where it is; *found* is a `Localised`."""
    scale = {} if found.scale is None else {"scale": found.scale}
    return {
        "verdict": found.verdict,
        "reason": found.reason,
        "T_map_camera": None if found.T_map_camera is None else matrix_bytes(found.T_map_camera),
        "covariance": None if found.covariance is None else upper_triangle(found.covariance),
        "inliers": found.inliers,
        "matches": found.matches,
        "version": version,
        **scale,
    }


def show_missing(robot: RobotId) -> dict[str, Any]:
    """Return the reply of ``live-show`` about a map that does not exist yet, or was stopped."""
    return {
        "keyframes": 0,
        "robots": [],
        "owner": "",
        "server": "",
        "epoch": 0,
        "version": 0,
        "links": 0,
        "state": "none",
        "you": {"robot": robot.name, "number": 0, "segment": 0},
    }


def show_reply(
    robot: RobotId,
    state: MapState,
    lease: LeaseRecord,
    *,
    told_state: str,
    name_of: Callable[[str], str],
    is_present: Callable[[str], bool],
) -> dict[str, Any]:
    """Return the reply of ``live-show``: the state of a map, and how *robot* numbers its keyframes.

    Args:
        robot: Who asks; ``you`` in the answer says how the robot numbers its next keyframe.
        state: The map.
        lease: Of its owner.
        told_state: As robots are told.
        name_of: Returns the name under which a `RobotId.folder` is shown.
        is_present: Returns whether that robot drives.
    """
    rows = [
        {
            "robot": name_of(each.robot),
            "segment": each.segment,
            "aligned": each.aligned,
            "reason": each.reason,
            "keyframes": state.live_map.next_number(each.robot),
            "present": is_present(each.robot),
        }
        for each in state.live_map.alignments()
    ]
    return {
        "keyframes": state.keyframes,
        "robots": rows,
        "owner": lease.owner,
        "server": lease.server,
        "epoch": lease.epoch,
        "version": state.position,
        "links": state.live_map.loop_closure_count,
        "state": told_state,
        "digest": state.digest(),
        "you": {
            "robot": name_of(robot.folder),
            "number": state.live_map.next_number(robot.folder),
            "segment": state.live_map.next_segment(robot.folder),
        },
    }


def paths_reply(state: MapState, name_of: Callable[[str], str]) -> list[dict[str, Any]]:
    """Return robot, segment and points (metres, in the map) of each segment in the map."""
    return [
        {"robot": name_of(robot), "segment": segment, "points": points.round(3).tolist()}
        for robot, segment, points in state.live_map.paths(_MAX_PATH_POINTS)
    ]


def version_reply(map_name: str, record: MapRecord) -> dict[str, Any]:
    """Return which version was published."""
    return {"name": map_name, "version": record.id, "number": record.number, "keyframes": record.keyframes}
