"""The robot SDK: connect, ask for poses, build maps.

Names are imported when they are first used, so that ``import client_sdk`` stays quick and needs
only numpy, websockets and msgspec.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rse_pf.errors import RsePfError

if TYPE_CHECKING:
    from client_sdk.blocking_robot import BlockingMapper, BlockingRobot, connect_blocking
    from client_sdk.commands.answer_types import Answer, PoseAnswer, decode_reply
    from client_sdk.commands.subscriptions import BlockingUpdates, Updates
    from client_sdk.commands.traffic_stats import Stats
    from client_sdk.datasets import Dataset, open_dataset
    from client_sdk.frontend import Frame, FrontEndOptions, MonocularOptions, PoseQuery, TrackedFrame
    from client_sdk.live import BlockingLiveMapper, Correction, LiveMapper, LiveOptions, OtherRobot
    from client_sdk.map_merge import merge_maps
    from client_sdk.mapper import Mapper
    from client_sdk.monocular.scale import MarkerScale, OdometryScale
    from client_sdk.offloading.offload_policy import CloudFirst
    from client_sdk.point_map import MapOptions, PointMap
    from client_sdk.recording import RobotRecorder
    from client_sdk.robot import Robot, connect
    from client_sdk.tracking.tracker import Tracker
    from client_sdk.trajectory import Trajectory
    from client_sdk.transfer.data_client import DataClient, DataOptions
    from client_sdk.wheel_odometry import OdometryReading

__all__ = [
    "Answer",
    "BlockingLiveMapper",
    "BlockingMapper",
    "BlockingRobot",
    "BlockingUpdates",
    "CloudFirst",
    "Correction",
    "DataClient",
    "DataOptions",
    "Dataset",
    "Frame",
    "FrontEndOptions",
    "LiveMapper",
    "LiveOptions",
    "MapOptions",
    "Mapper",
    "MarkerScale",
    "MonocularOptions",
    "OdometryReading",
    "OdometryScale",
    "OtherRobot",
    "PointMap",
    "PoseAnswer",
    "PoseQuery",
    "Robot",
    "RobotRecorder",
    "RsePfError",
    "Stats",
    "TrackedFrame",
    "Tracker",
    "Trajectory",
    "Updates",
    "connect",
    "connect_blocking",
    "decode_reply",
    "merge_maps",
    "open_dataset",
]

_HOMES = {
    "Answer": "commands.answer_types",
    "BlockingLiveMapper": "live",
    "BlockingMapper": "blocking_robot",
    "BlockingRobot": "blocking_robot",
    "BlockingUpdates": "commands.subscriptions",
    "CloudFirst": "offloading.offload_policy",
    "Correction": "live",
    "DataClient": "transfer.data_client",
    "DataOptions": "transfer.data_client",
    "Dataset": "datasets",
    "Frame": "frontend",
    "FrontEndOptions": "frontend",
    "LiveMapper": "live",
    "LiveOptions": "live",
    "MapOptions": "point_map",
    "Mapper": "mapper",
    "MarkerScale": "monocular.scale",
    "MonocularOptions": "frontend",
    "OdometryReading": "wheel_odometry",
    "OdometryScale": "monocular.scale",
    "OtherRobot": "live",
    "PointMap": "point_map",
    "PoseAnswer": "commands.answer_types",
    "PoseQuery": "frontend",
    "Robot": "robot",
    "RobotRecorder": "recording",
    "Stats": "commands.traffic_stats",
    "TrackedFrame": "frontend",
    "Tracker": "tracking.tracker",
    "Trajectory": "trajectory",
    "Updates": "commands.subscriptions",
    "connect": "robot",
    "connect_blocking": "blocking_robot",
    "decode_reply": "commands.answer_types",
    "merge_maps": "map_merge",
    "open_dataset": "datasets",
}


def __getattr__(name: str) -> Any:
    """Import *name* from the module that defines it."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'client_sdk' has no attribute {name!r}")
    return getattr(importlib.import_module(f"client_sdk.{home}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
