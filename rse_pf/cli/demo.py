"""Run robots that build point-cloud maps with the PnP service, all on this machine.

Without --data, robots drive through a rendered world whose true poses are known.  With --merge each robot
starts in a world frame of its own, and at the end their maps are merged into one.  With --live they make one
map together while they drive.

examples:
  rse-pf demo --out out
  rse-pf demo --data recordings/kitchen --rate 10 --robots 1 --out out-kitchen
  rse-pf demo --data recordings/kitchen --rate 10 --robots 3 --merge --out out-merged
  rse-pf demo --data recordings/kitchen --rate 10 --robots 3 --live --out out-live
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from client_sdk.source_facts import check_accepted, unresolved
from rse_pf.command_line.extras import require
from rse_pf.command_line.sensors import add_check_argument, add_sensor_arguments, show_source
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.recording.writer import with_recordings
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_MAX_ROBOTS = 32


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data", "--recording", type=Path, metavar="DIR",
        help="a recording in the layout of TUM, EuRoC or KITTI, NYU Depth V2, or a ROS bag",
    )  # fmt: skip
    add_sensor_arguments(parser)
    parser.add_argument(
        "--robots",
        type=int,
        help="robots that share the recording (default: 3; with --data, but neither --merge nor --live: 1)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=5.0,
        metavar="HZ",
        help="frames per second; the recording's own rate plays all (default: 5)",
    )
    parser.add_argument(
        "--engine",
        choices=("native", "opencv"),
        default="native",
        help="PnP solver (default: native)",
    )
    parser.add_argument(
        "--codec",
        choices=("zlib", "json", "bin"),
        default="zlib",
        help="encoding (default: zlib, as in the paper)",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="folder of results (default: out)"
    )
    parser.add_argument(
        "--frames",
        type=int,
        help="frames per robot in the rendered world (default: 80; with --merge or --live, what it needs)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the rendered world (default: 0)")
    parser.add_argument(
        "--frontend", choices=("standard", "wide-baseline"), default="standard",
        help="wide-baseline: for frames that are 0.4 to 0.8 m apart, such as those of NYU",
    )  # fmt: skip
    parser.add_argument(
        "--features", metavar="MODULE:FUNCTION",
        help="find features with this function instead of ORB: see docs/own_parts.md",
    )  # fmt: skip
    parser.add_argument(
        "--merge",
        action="store_true",
        help="merge the maps of all robots at the end; of one robot, close its loops",
    )
    parser.add_argument(
        "--live", action="store_true", help="all robots make one live map, and correct each other at once"
    )
    parser.add_argument(
        "--record", type=Path, metavar="DIR",
        help="record what robots and servers say in DIR, for rse-pf replay (recording.folder)",
    )  # fmt: skip
    add_check_argument(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bars")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the options and run the demo."""
    robots = (
        args.robots
        if args.robots is not None
        else (1 if args.data is not None and not (args.merge or args.live) else 3)
    )
    if not 1 <= robots <= _MAX_ROBOTS:
        hint = "choose at least one robot" if robots < 1 else "choose fewer robots"
        raise UsageError(f"--robots {robots} is not within 1..{_MAX_ROBOTS}", hint=hint)
    if not (math.isfinite(args.rate) and 0.1 <= args.rate <= 60):
        raise UsageError(
            f"--rate {args.rate:g} is not within 0.1..60 Hz", hint="5 is the paper's; most recordings have 30"
        )
    if args.frames is not None and not 2 <= args.frames <= 2000:
        raise UsageError(f"--frames {args.frames} is not within 2..2000", hint="80 is a path of 5.5 m")
    if args.frames is not None and args.data is not None:
        raise UsageError(
            "--frames is for the rendered world: a recording is played whole",
            hint="play fewer of its frames with --rate, or leave out one of them",
        )
    if args.seed < 0:
        raise UsageError(f"--seed {args.seed} is below 0", hint="choose 0 or more")
    if args.live and args.merge:
        raise UsageError("--live and --merge exclude each other", hint="a live map needs no merge")
    require("demo --merge" if args.merge else "demo")
    from client_sdk.plugins import load_features

    load_features(args.features)
    settings = with_recordings(settings, args.record)
    from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo

    shown: tuple[str, ...] = ()
    if args.data is not None:
        from client_sdk.datasets import open_dataset

        check_accepted(args.accept)
        dataset = open_dataset(args.data, camera=args.camera, imu=args.imu)
        dataset.check()
        shown = show_source(dataset.notes, unresolved(dataset.log.doubts, args.accept))
        thinned = dataset.thinned(args.rate)
        if len(thinned) < len(dataset):
            show(
                f"note: {len(thinned)} of {counted(len(dataset), 'frame')} are played at --rate {args.rate:g}"
            )
        frames = len(thinned.share(robots - 1, robots))
        if not frames:
            raise UsageError(f"{args.data} has too few frames for {robots} robots", hint="use fewer robots")
    options = DemoOptions(
        data=args.data,
        camera=args.camera,
        imu=args.imu,
        robots=robots,
        rate_hz=args.rate,
        engine=args.engine,
        codec=args.codec,
        out=args.out,
        frames=args.frames,
        seed=args.seed,
        frontend=args.frontend,
        features=args.features,
        merge=args.merge,
        live=args.live,
        quiet=args.quiet,
        check=args.check,
        accepted=tuple(args.accept),
        shown=shown,
    )
    return run_demo(options, settings)
