"""Make a map from a ROS bag, and write maps as bags: ``rse-pf map from-bag`` and ``rse-pf map to-bag``.

Needs no ROS.  The bag is read by `client_sdk.bags`, and driven like a camera.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from rse_pf.cli.maps.from_camera import add_drive_arguments, check_drive, errors_of, map_source
from rse_pf.command_line.extras import require
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import at_work, counted, show

if TYPE_CHECKING:
    from client_sdk.bags import BagKind, BagOptions
    from client_sdk.trajectory import Trajectory
    from rse_pf.maps.format import MapVersion

__all__ = ["BAG_ACTIONS", "add_bag_actions", "export_bag", "run_bags"]

BAG_ACTIONS = ("from-bag", "to-bag")
_ENDINGS: dict[str, BagKind] = {".bag": "ros1", ".db3": "sqlite3", ".mcap": "mcap"}


def add_bag_actions(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``map from-bag`` and ``map to-bag``."""
    _add_from_bag(
        actions.add_parser(
            "from-bag", help="make a map from a ROS bag, without ROS",
            description="Make a map from a ROS 1 bag, or a ROS 2 bag (sqlite3, MCAP), through a platform.",
            epilog="example:\n  rse-pf map from-bag kitchen.bag --out out-bag",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
    )  # fmt: skip
    _add_to_bag(
        actions.add_parser(
            "to-bag", help="write paths and clouds as a ROS bag",
            description="Write the paths and the cloud of a folder of results as a ROS bag.",
            epilog="example:\n  rse-pf map to-bag out-bag --out map.mcap",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
    )  # fmt: skip


def run_bags(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one of these actions, and return the exit code."""
    return _from_bag(args, settings) if args.action == "from-bag" else _to_bag(args)


def _add_from_bag(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="BAG", help="a .bag, .db3 or .mcap file, or the folder of a ROS 2 bag")
    add(
        "--colour", metavar="TOPIC",
        help="topic of the colours, or of the left camera (default: found by its type)",
    )  # fmt: skip
    add("--right", metavar="TOPIC", help="topic of the right camera (default: by its name, without depth)")
    add("--depth", metavar="TOPIC", help="topic of the depth (default: found by its type)")
    imu = parser.add_mutually_exclusive_group()
    imu.add_argument("--imu", metavar="TOPIC", help="topic of the IMU (default: found by its type)")
    imu.add_argument("--no-imu", action="store_true", help="leave the IMU out")
    add("--info", metavar="TOPIC", help="topic of the camera of the colours (default: beside them)")
    add("--truth", metavar="TOPIC", help="topic of true poses (default: tf, or a PoseStamped topic)")
    add(
        "--pair-within", type=float, default=0.02, metavar="S",
        help="images belong together up to this difference of time (default: %(default)s s)",
    )  # fmt: skip
    add(
        "--depth-scale", type=float, metavar="N",
        help="units of 16-bit depth in a metre (default: what the bag states, else 1000)",
    )  # fmt: skip
    add_drive_arguments(parser, Path("out-bag"))


def _add_to_bag(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", type=Path, metavar="DIR", help="results of demo, map from-bag or map from-camera")
    add("--out", type=Path, required=True, metavar="BAG", help="the new bag: .bag, .db3, .mcap, or a folder")
    add(
        "--format", choices=tuple(_ENDINGS.values()),
        help="its format (default: by the ending of BAG; mcap for a folder)",
    )  # fmt: skip


def _from_bag(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Track the frames of a bag and write the results; the exit code is 1 if most have no pose."""
    require("map from-bag")
    scale = check_drive(args)
    options = _options(args)
    from client_sdk.bags import open_bag
    from client_sdk.cameras import source_of_frames
    from client_sdk.check.motion import MotionReference
    from client_sdk.datasets.recordings import dataset_of_bag

    with at_work(f"reading {args.source}"):
        bag = open_bag(Path(args.source), options)
    show(*bag.notes)
    frames = dataset_of_bag(bag)
    if args.rate is not None:
        frames = frames.thinned(args.rate)
    with source_of_frames(
        args.source,
        frames,
        bag.camera,
        has_depth=bag.has_depth,
        has_stereo=bag.has_stereo,
        close=bag.close,
        log=frames.log,
        span_s=frames.span_s,
    ) as source:
        frames.check()

        def about(path: Trajectory) -> dict[str, Any]:
            return {
                "bag": args.source,
                "topics": {
                    name: topic.name
                    for name, topic in (
                        ("colour", bag.chosen.colour),
                        ("right", bag.chosen.right),
                        ("depth", bag.chosen.depth),
                        ("imu", None if bag.imu is None else bag.chosen.imu),
                    )
                    if topic is not None
                },
                "notes": list(bag.notes),
                **errors_of(path, bag.truth, bag.truth_kind),
            }

        reference = MotionReference.of_truth(bag.truth, bag.truth_kind, is_camera=False)
        return map_source(args, settings, source, scale, about, reference)


def _to_bag(args: argparse.Namespace) -> int:
    """Write the results of a folder as a bag."""
    require("map to-bag")
    kind = _kind(args.out, args.format)
    from client_sdk.bags import write_map_bag
    from client_sdk.point_map import read_ply
    from client_sdk.trajectory import read_trajectory

    folders = _robot_folders(args.source)
    paths = [(path.name if path != args.source else "robot", read_trajectory(path / "trajectory.txt"))
             for path in folders]  # fmt: skip
    clouds = [read_ply(path / "map.ply") for path in folders]
    merged = args.source / "merged.ply"
    if merged.is_file():
        clouds = [read_ply(merged)]
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([colour for _, colour in clouds])
    messages = write_map_bag(args.out, kind, paths, points, colours)
    show(f"{args.out}: {counted(messages, 'message')}, {counted(len(points), 'point')}, "
         f"{counted(len(paths), 'path')}")  # fmt: skip
    return 0


def export_bag(file: Path, version: MapVersion) -> int:
    """Write a version of a map as one MCAP file that ROS 2 and Foxglove read; return its size, bytes.

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


def _options(args: argparse.Namespace) -> BagOptions:
    from client_sdk.bags import BagOptions, lens_or_rig

    lens, rig = (None, None) if args.intrinsics is None else lens_or_rig(args.intrinsics)
    return BagOptions(
        colour=args.colour,
        depth=args.depth,
        info=args.info,
        truth=args.truth,
        right=args.right,
        imu=args.imu,
        use_imu=False if args.no_imu else None,
        lens=lens,
        rig=rig,
        depth_scale=args.depth_scale,
        pair_within_s=args.pair_within,
        use_depth=not args.no_depth,
    )


def _kind(out: Path, named: BagKind | None) -> BagKind:
    by_ending = _ENDINGS.get(out.suffix)
    if named is None:
        return by_ending or "mcap"
    if by_ending not in (None, named):
        raise UsageError(f"{out} does not end like a bag of {named}", hint="leave out --format, or rename it")
    if named == "ros1" and by_ending is None:
        raise UsageError(f"{out} is not named .bag", hint="a ROS 1 bag is one file: name it .bag")
    return named


def _robot_folders(folder: Path) -> list[Path]:
    """Return the folders that hold a trajectory: the folder itself, or those of the demo's robots."""
    found = [
        each for each in (folder, *sorted(folder.glob("robot-*"))) if (each / "trajectory.txt").is_file()
    ]
    if not found:
        raise UsageError(
            f"{folder} holds no trajectory.txt and map.ply",
            hint="name the folder of results of rse-pf demo, map from-bag or map from-camera",
        )
    return found
