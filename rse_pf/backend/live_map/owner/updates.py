"""What the owner of a live map tells the robots: the newest payload of each key, as plain values.

A payload is told when it differs from the last one of its key; a new reader gets all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from rse_pf.geometry import Array
from rse_pf.live_map.events import KeyframeAdded, matrix_bytes
from rse_pf.live_map.outcomes import Alignment, Corrected, Outcome

__all__ = ["UpdateBook", "upper_triangle"]

Payload = dict[str, Any]
_UPPER = np.triu_indices(6)
_NEVER = ("cause", "version")
"""A payload that differs in these only is not told again."""


class UpdateBook:
    """The present state of one map as payloads by key."""

    def __init__(self, name_of: Callable[[str], str]) -> None:
        """Know nothing yet; *name_of* returns the name under which a `RobotId.folder` is shown."""
        self._name_of = name_of
        self._payloads: dict[str, Payload] = {}
        self._alignments: dict[str, Alignment] = {}

    def present(self) -> list[Payload]:
        """Return all payloads, those of the map first."""
        return sorted(self._payloads.values(), key=lambda each: str(each["kind"]) != "map")

    def align(
        self, alignments: Iterable[Alignment], outcomes: Iterable[Outcome], version: int
    ) -> list[Payload]:
        """Take where the segments lie now, and return what is new; outcomes name the causes."""
        causes = {each.robot: each.cause for each in outcomes if isinstance(each, Corrected)}
        self._alignments = {each.robot: each for each in alignments}
        told = []
        for folder, each in self._alignments.items():
            cause = causes.get(folder)
            payload = {
                "kind": "alignment", "robot": self._name_of(folder), "segment": each.segment,
                "aligned": each.aligned, "reason": each.reason, "T_map_odom": _matrix(each.T_map_odom),
                "version": version,
                "covariance": None if each.covariance is None else upper_triangle(each.covariance),
                "cause": None if cause is None else {"robot": self._name_of(cause[0]), "number": cause[1]},
            }  # fmt: skip
            told += self._put(payload)
        gone = {
            f"{kind}/{self._name_of(folder)}" for kind in ("alignment", "pose") for folder in self._alignments
        }
        for key in [key for key in self._payloads if key != "map" and key not in gone]:
            del self._payloads[key]
        return told

    def place(self, event: KeyframeAdded) -> list[Payload]:
        """Take a keyframe, and return the pose that the robot had there if its segment is aligned."""
        found = self._alignments.get(event.robot)
        if found is None or not found.aligned or found.segment != event.segment or found.T_map_odom is None:
            return []
        T_map_camera = found.T_map_odom @ event.keyframe.T_odom_camera
        return self._put(
            {
                "kind": "pose",
                "robot": self._name_of(event.robot),
                "segment": event.segment,
                "timestamp_s": event.keyframe.timestamp_s,
                "T_map_camera": matrix_bytes(T_map_camera),
            }
        )

    def knows_segment(self, event: KeyframeAdded) -> bool:
        """Return whether the segment of a keyframe is the one that was last told."""
        found = self._alignments.get(event.robot)
        return found is not None and found.segment == event.segment

    def describe(self, *, keyframes: int, version: int, owner: str, state: str) -> list[Payload]:
        """Take the state of the map, and return it if it is new."""
        payload = {"kind": "map", "keyframes": keyframes, "version": version, "owner": owner, "state": state}
        is_new = payload != self._payloads.get("map")
        self._payloads["map"] = payload
        return [payload] if is_new else []

    def _put(self, payload: Payload) -> list[Payload]:
        key = f"{payload['kind']}/{payload['robot']}"
        before = self._payloads.get(key)
        self._payloads[key] = payload
        return [] if before is not None and _without_cause(before) == _without_cause(payload) else [payload]


def _without_cause(payload: Payload) -> Payload:
    return {name: value for name, value in payload.items() if name not in _NEVER}


def _matrix(matrix: Array | None) -> bytes | None:
    return None if matrix is None else matrix_bytes(matrix)


def upper_triangle(covariance: Array) -> bytes:
    """Return the 21 numbers of a ``(6, 6)`` covariance on and above its diagonal, row by row."""
    return matrix_bytes(covariance[_UPPER])
