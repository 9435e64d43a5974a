"""Make a map from a ROS bag, and write maps as bags: ``rse-pf map from-bag`` and ``rse-pf map to-bag``.

ROS need not be installed.  `client_sdk.bags` reads the bag, and its frames are tracked like those of a
camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rse_pf.cli.maps.from_camera import DriveRequest, check_drive, map_source
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import at_work, counted, show

if TYPE_CHECKING:
    from client_sdk.bags import BagKind, BagOptions

__all__ = ["FromBagRequest", "ToBagRequest", "run_from_bag", "run_to_bag"]

# Format of a bag by the ending of its file name.
_ENDINGS: dict[str, BagKind] = {".bag": "ros1", ".db3": "sqlite3", ".mcap": "mcap"}


@dataclass(frozen=True, kw_only=True)
class FromBagRequest(DriveRequest):
    """The options of rse-pf map from-bag: a ROS bag, its topics, and those of every drive."""

    author = "rse-pf map from-bag"
    source: str = option(metavar="BAG", help="a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag")
    out: Path = option("--out", default=Path("out-bag"), metavar="DIR", help="results (default: %(default)s)")
    colour: str | None = option(
        "--colour",
        metavar="TOPIC",
        help="topic of the colour images, or of the left camera (default: found by its type)",
    )
    right: str | None = option(
        "--right",
        metavar="TOPIC",
        help="topic of the right camera (default: found by its name, if there is no depth)",
    )
    depth: str | None = option(
        "--depth", metavar="TOPIC", help="topic of the depth images (default: found by its type)"
    )
    imu: str | None = option(
        "--imu", exclusive="imu", metavar="TOPIC", help="topic of the IMU (default: found by its type)"
    )
    no_imu: bool = option("--no-imu", exclusive="imu", help="do not use the IMU")
    info: str | None = option(
        "--info",
        metavar="TOPIC",
        help="topic of the camera info (default: the one next to the colour images)",
    )
    truth: str | None = option(
        "--truth",
        metavar="TOPIC",
        help="topic of ground-truth poses (default: tf, or a PoseStamped topic)",
    )
    pair_within: float = option(
        "--pair-within",
        default=0.02,
        metavar="S",
        help="largest difference of time between images that belong together (default: %(default)s s)",
    )
    depth_scale: float | None = option(
        "--depth-scale",
        metavar="N",
        help="units of 16-bit depth in a metre (default: what the bag states, else 1000)",
    )


@dataclass(frozen=True, kw_only=True)
class ToBagRequest:
    """The options of rse-pf map to-bag: a folder of results, and the ROS bag that is written."""

    source: Path = option(metavar="DIR", help="results of demo, map from-bag or map from-camera")
    out: Path = option(
        "--out", required=True, metavar="BAG", help="the new bag: .bag, .db3, .mcap, or a folder"
    )
    format: BagKind | None = option(
        "--format",
        choices=tuple(_ENDINGS.values()),
        help="its format (default: by the ending of BAG; mcap for a folder)",
    )


def run_from_bag(request: FromBagRequest, settings: PlatformSettings) -> int:
    """Track the frames of a bag and write the results; return 0.

    Raises:
        CommandFailed: Half of the frames or more have no pose; the results are written nevertheless.
        UsageError: The bag cannot be read, or options contradict each other.
    """
    require("map from-bag")
    scale = check_drive(request)
    options = _options(request)
    from client_sdk.bags import open_bag
    from client_sdk.cameras import source_of_recording

    with at_work(f"reading {request.source}"):
        bag = open_bag(Path(request.source), options)
    show(*bag.notes)
    frames = bag if request.rate is None else bag.thinned(request.rate)
    about = {"bag": request.source, "topics": bag.topics, "notes": list(bag.notes)}
    with source_of_recording(request.source, replace(frames, notes=())) as source:
        frames.check()
        return map_source(request, settings, source, scale, about=about)


def run_to_bag(request: ToBagRequest, settings: PlatformSettings) -> int:
    """Write trajectories and point clouds of a folder of results as a bag; return 0.

    If there is a merged cloud, it is written in place of the robots' clouds.
    """
    require("map to-bag")
    kind = _kind(request.out, request.format)
    from client_sdk.bags import write_map_bag
    from client_sdk.point_map import read_ply
    from client_sdk.trajectory import read_trajectory

    folders = _robot_folders(request.source)
    paths = [(path.name if path != request.source else "robot", read_trajectory(path / "trajectory.txt"))
             for path in folders]  # fmt: skip
    clouds = [read_ply(path / "map.ply") for path in folders]
    merged = request.source / "merged.ply"
    if merged.is_file():
        clouds = [read_ply(merged)]
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([colour for _, colour in clouds])
    messages = write_map_bag(request.out, kind, paths, points, colours)
    show(f"{request.out}: {counted(messages, 'message')}, {counted(len(points), 'point')}, "
         f"{counted(len(paths), 'path')}")  # fmt: skip
    return 0


def _options(request: FromBagRequest) -> BagOptions:
    """Return the options with which the bag is opened; raises UsageError if --intrinsics cannot be read."""
    from client_sdk.bags import BagOptions, lens_or_rig

    lens, rig = (None, None) if request.intrinsics is None else lens_or_rig(request.intrinsics)
    return BagOptions(
        colour=request.colour,
        depth=request.depth,
        info=request.info,
        truth=request.truth,
        right=request.right,
        imu=request.imu,
        use_imu=False if request.no_imu else None,
        lens=lens,
        rig=rig,
        depth_scale=request.depth_scale,
        pair_within_s=request.pair_within,
        use_depth=not request.no_depth,
    )


def _kind(out: Path, named: BagKind | None) -> BagKind:
    """Return the format of the bag *out*: *named*, else by its ending, else MCAP.

    Raises:
        UsageError: The ending is that of another format, or a ROS 1 bag is not named ``.bag``.
    """
    by_ending = _ENDINGS.get(out.suffix)
    if named is None:
        return by_ending or "mcap"
    if by_ending not in (None, named):
        raise UsageError(f"{out} does not end like a bag of {named}", hint="leave out --format, or rename it")
    if named == "ros1" and by_ending is None:
        raise UsageError(f"{out} is not named .bag", hint="a ROS 1 bag is one file: name it .bag")
    return named


def _robot_folders(folder: Path) -> list[Path]:
    """Return the folders with a trajectory: *folder* itself, and its subfolders ``robot-*`` of a demo.

    Raises:
        UsageError: There is none.
    """
    found = [
        each for each in (folder, *sorted(folder.glob("robot-*"))) if (each / "trajectory.txt").is_file()
    ]
    if not found:
        raise UsageError(
            f"{folder} holds no trajectory.txt and map.ply",
            hint="name the folder of results of rse-pf demo, map from-bag or map from-camera",
        )
    return found
