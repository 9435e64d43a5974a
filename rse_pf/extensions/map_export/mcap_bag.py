"""Write a map as a bag of ROS 2, an MCAP file, which Foxglove also reads."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rse_pf.command_line.extras import require
from rse_pf.maps.format import MapVersion

__all__ = ["export_bag"]


def export_bag(file: Path, version: MapVersion) -> int:
    """Write *version* of a map as the MCAP *file*, which ROS 2 and Foxglove read; return its size in bytes.

    It holds the path of each robot's keyframes, and the points with colours.

    Raises:
        MissingExtra: ``rosbags`` is not installed.
    """
    require("map to-bag")
    from client_sdk.bags import write_map_bag
    from client_sdk.trajectory import Trajectory

    paths = []
    for robot in sorted({keyframe.robot for keyframe in version.keyframes}):
        own = sorted((k for k in version.keyframes if k.robot == robot), key=lambda k: k.timestamp_s)
        poses = np.stack([k.T_world_camera for k in own])
        paths.append((robot, Trajectory(np.array([k.timestamp_s for k in own]), poses)))
    with TemporaryDirectory(prefix=".export-", dir=file.absolute().parent) as folder:
        bag = Path(folder) / "map.mcap"
        write_map_bag(bag, "mcap", paths, version.points, version.colours)
        bag.replace(file)
    return file.stat().st_size
