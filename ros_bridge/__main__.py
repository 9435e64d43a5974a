"""Run a bridge: ``python -m ros_bridge ros1``, ``ros2`` or ``dds``."""

from __future__ import annotations

import argparse
import importlib.resources
import sys
from dataclasses import fields

from ros_bridge.options import BridgeOptions
from rse_pf.errors import RsePfError
from rse_pf.terminal import show, show_error

_HELP = {
    "url": "address of the platform: ws://HOST:PORT/ws",
    "token_file": "file that holds the robot's token",
    "enrolment": "file of rse-pf robot enrol --out, instead of both",
    "namespace": "name of this robot, before its topics and frames",
    "map": "live map that it shares with other robots (default: a map of its own)",
    "colour": "topic of the colours",
    "depth": "topic of depth registered to them; empty: none",
    "info": "topic of the camera_info of the colours",
    "right": "topic of the right images of a stereo pair, instead of depth; empty: none",
    "right_info": "topic of the camera_info of the right images",
    "imu": "topic of an IMU; needs rig",
    "rig": "file of the rig, rig.json; empty: by both camera_info",
    "depth_scale": "units of a 16-bit depth image in a metre",
    "pair_within_s": "colour and depth belong together up to this difference of time",
    "queue_frames": "so many frames wait while another is tracked",
    "map_frame": "name of the frame of the map",
    "odom_frame": "name of the odometry frame",
    "camera_frame": "name of the camera's frame (default: as in the images)",
    "publish_odom": "whether to publish the transform from odometry frame to camera",
    "cloud_every_s": "time between two clouds",
    "path_poses": "most poses of a path",
    "dds_domain": "with dds: ROS_DOMAIN_ID of the robots",
    "out": "folder that the service save writes to",
    "publish_as": "name of the map that the service publish makes of a map of its own",
    "localise_in": "name of the map in which the service localise looks",
}


def main(arguments: list[str] | None = None) -> int:
    """Run the bridge that the command line names; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="rse-pf-ros",
        description="Bridge a robot of ROS to the platform: images in; poses, paths, transforms, clouds out.",
        epilog="example:\n  rse-pf-ros ros1 --url ws://127.0.0.1:8700/ws --token-file robot.token",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "shell", choices=("ros1", "ros2", "dds", "where"),
        help="ros1: rospy; ros2: rclpy; dds: Cyclone DDS without ROS; "
        "where: print the folder for ROS_PACKAGE_PATH",
    )  # fmt: skip
    for each in fields(BridgeOptions):
        parser.add_argument(
            f"--{each.name.replace('_', '-')}", dest=each.name, default=argparse.SUPPRESS, metavar="VALUE",
            help=f"{_HELP[each.name]}{'' if each.default in ('', None) else f' (default: {each.default})'}",
        )  # fmt: skip
    args, others = parser.parse_known_args(arguments)
    unknown = [word for word in others if ":=" not in word]
    if unknown:
        parser.error(f"unknown option: {' '.join(unknown)}")
    given = {name: value for name, value in vars(args).items() if name != "shell"}
    try:
        if args.shell == "where":
            show(str(importlib.resources.files("ros_bridge") / "packages"))
            return 0
        if args.shell == "ros1":
            from ros_bridge.ros1_node import run_ros1_node

            return run_ros1_node(["rse-pf-ros", *others], given)
        if args.shell == "ros2":
            from ros_bridge.ros2_node import run_ros2_node

            return run_ros2_node(others, given)
        from ros_bridge.dds import run_dds

        return run_dds(given)
    except RsePfError as error:
        show_error(error)
        return 1


if __name__ == "__main__":
    sys.exit(main())
