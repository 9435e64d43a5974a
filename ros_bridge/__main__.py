"""Run a bridge: ``python -m ros_bridge ros1`` or ``ros2``."""

from __future__ import annotations

import argparse
import importlib.resources
import sys
from dataclasses import fields
from typing import NoReturn

from ros_bridge.options import HELP, BridgeOptions
from rse_pf.errors import RsePfError, UsageError
from rse_pf.terminal import show, show_error


class _Parser(argparse.ArgumentParser):
    """An argument parser that reports a wrong argument as one line with a hint, without the usage text."""

    def error(self, message: str) -> NoReturn:
        show_error(UsageError(f"{self.prog}: {message}", hint=f"see {self.prog} --help"))
        raise SystemExit(2)


def main(arguments: list[str] | None = None) -> int:
    """Run the shell that *arguments* name (None: those of the process); return the exit code."""
    parser = _Parser(
        prog="rse-pf-ros",
        description="Bridge a robot of ROS to the platform: images in; poses, paths, transforms, clouds out.",
        epilog="example:\n  rse-pf-ros ros1 --url ws://127.0.0.1:8700/ws --token-file robot.token",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "shell", choices=("ros1", "ros2", "where"),
        help="ros1: rospy; ros2: rclpy; where: print the folder for ROS_PACKAGE_PATH",
    )  # fmt: skip
    for each in fields(BridgeOptions):
        parser.add_argument(
            f"--{each.name.replace('_', '-')}", dest=each.name, default=argparse.SUPPRESS, metavar="VALUE",
            help=f"{HELP[each.name]}{'' if each.default in ('', None) else f' (default: {each.default})'}",
        )  # fmt: skip
    words = sys.argv[1:] if arguments is None else arguments
    mark = words.index("--ros-args") if "--ros-args" in words else len(words)
    args, others = parser.parse_known_args(words[:mark])
    of_ros = words[mark:] if args.shell == "ros2" else []
    unknown = [word for word in [*others, *words[mark + len(of_ros) :]] if ":=" not in word]
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
        from ros_bridge.ros2_node import run_ros2_node

        return run_ros2_node([*others, *of_ros], given)
    except RsePfError as error:
        show_error(error)
        return 1
    except KeyboardInterrupt:  # Ctrl-C before the bridge runs; a running bridge handles it and returns 0
        return 130


if __name__ == "__main__":
    sys.exit(main())
