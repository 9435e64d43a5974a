"""Robots whose platform is one live map in this process, which measures loop closures at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from rse_pf.live_map.events import KeyframeAdded
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, OptimiseWanted
from rse_pf.slam.keyframe import decode_keyframe
from tests.kit.fake_live_map import FakeLiveRobot

__all__ = ["SharedMap"]

_UPPER = np.triu_indices(6)


class SharedMap:
    """One live map and its robots, by name."""

    def __init__(self) -> None:
        self.live_map = LiveMap()
        self.robots: dict[str, SharingRobot] = {}
        self._told: dict[str, Any] = {}

    def robot(self, name: str) -> SharingRobot:
        """Return a robot of this map."""
        made = self.robots[name] = SharingRobot(self, name)
        return made

    def add(self, name: str, request: Any) -> None:
        """Add a keyframe to the map, and publish all alignments to all robots."""
        live_map = self.live_map
        outcomes = live_map.apply(
            KeyframeAdded(robot=name, segment=request.segment, number=request.number, data=request.keyframe)
        )
        added = next(outcome for outcome in outcomes if isinstance(outcome, Added))
        outcomes = live_map.apply(live_map.measure(added.id))
        if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
            live_map.apply(live_map.optimise())
        for alignment in live_map.alignments():
            payload = {
                "kind": "alignment", "robot": alignment.robot, "segment": alignment.segment,
                "aligned": alignment.aligned, "reason": alignment.reason, "version": live_map.events,
                "T_map_odom": None if alignment.T_map_odom is None else alignment.T_map_odom.ravel().tolist(),
                "covariance": None, "scale": alignment.scale,
            }  # fmt: skip
            for robot in self.robots.values():
                robot.publish(f"alignment/{alignment.robot}", payload)


class SharingRobot(FakeLiveRobot):
    """One robot of a shared map."""

    def __init__(self, shared: SharedMap, name: str) -> None:
        super().__init__()
        self.name = name
        self._shared = shared

    def _show(self, request: Any) -> Any:
        self.foreign_keyframes = self._shared.live_map.keyframes - len(self.kept)
        reply = super()._show(request)
        reply["you"]["robot"] = self.name
        return reply

    def _keyframe(self, request: Any) -> Any:
        known = len(self.kept)
        reply = super()._keyframe(request)
        if len(self.kept) > known:
            self._shared.add(self.name, self.kept[-1])
        return reply

    def _relocalise(self, request: Any) -> Any:
        found = self._shared.live_map.relocalise(decode_keyframe(request.keyframe))
        pose = found.T_map_camera
        return {
            "verdict": found.verdict, "reason": found.reason, "scale": found.scale,
            "T_map_camera": None if pose is None else pose.ravel().tolist(),
            "covariance": None if found.covariance is None else found.covariance[_UPPER].tolist(),
        }  # fmt: skip
