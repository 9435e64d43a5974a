"""Compare configurations of the tracker on recordings: accuracy, lost frames, bytes and CPU time.

CONFIG is built in (default, live, wide-baseline, without-depth, features-500), a file NAME.toml or NAME.py
with options and functions of your own, or module:function for features.  A recording is a folder in the
layout of TUM, EuRoC or KITTI, NYU Depth V2, a ROS bag, or world:SEED, which is rendered.  Poses are solved in
this process, so that every run gives the same.

examples:
  rse-pf compare --data world:3
  rse-pf compare default features-500 mine.py --data recordings/kitchen --rate 10 5 --out out-compare
  rse-pf compare --data recordings/MH_01 --camera left --no-imu
  rse-pf compare default without-depth --data recordings/kitchen recordings/MH_01 --runs 3
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from client_sdk.source_facts import check_accepted
from rse_pf.command_line.extras import require
from rse_pf.command_line.sensors import add_accept_argument, add_sensor_arguments
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError

__all__ = ["add_arguments", "run"]

_MAX_RUNS = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "configs", nargs="*", default=["default"], metavar="CONFIG",
        help="a name, NAME.toml, NAME.py or MODULE:FUNCTION (default: default)",
    )  # fmt: skip
    parser.add_argument(
        "--data", "--recording", nargs="+", required=True, metavar="RECORDING",
        help="folders, ROS bags, or world:SEED",
    )  # fmt: skip
    parser.add_argument(
        "--rate", nargs="+", type=float, default=[], metavar="HZ",
        help="play so many frames per second, one after the other (default: all)",
    )  # fmt: skip
    add_sensor_arguments(parser)
    add_accept_argument(parser)
    parser.add_argument(
        "--runs", type=int, default=1, metavar="N", help="run each so often, and show the spread (default: 1)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out-compare"), metavar="DIR",
        help="folder of results (default: out-compare)",
    )  # fmt: skip
    parser.add_argument(
        "--platform",
        action="store_true",
        help="solve the poses by a platform that is started on this machine",
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the options and run the comparison."""
    if not 1 <= args.runs <= _MAX_RUNS:
        raise UsageError(f"--runs {args.runs} is not within 1..{_MAX_RUNS}", hint="3 show a spread")
    for rate_hz in args.rate:
        if not (math.isfinite(rate_hz) and 0.1 <= rate_hz <= 1000):
            raise UsageError(
                f"--rate {rate_hz:g} is not within 0.1..1000 Hz", hint="leave it out to play all frames"
            )
    check_accepted(args.accept)
    require("compare")
    from rse_pf.extensions.experiments.compare.configurations import configurations_of
    from rse_pf.extensions.experiments.compare.recordings import drives_of
    from rse_pf.extensions.experiments.compare.run import CompareOptions, run_compare

    options = CompareOptions(
        configurations=configurations_of(args.configs),
        drives=drives_of(args.data, args.rate, camera=args.camera, imu=args.imu),
        runs=args.runs, out=args.out, platform=args.platform,
        accepted=tuple(args.accept),
    )  # fmt: skip
    return run_compare(options, settings)
