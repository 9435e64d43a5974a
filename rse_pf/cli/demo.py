"""Let robots build point-cloud maps through the PnP service, all on this machine.

Without --data, robots drive through a rendered world whose true poses are known.  With --merge each robot
starts in a world of its own, and at the end their maps become one.

examples:
  rse-pf demo --out out
  rse-pf demo --data recordings/kitchen --rate 10 --robots 1 --out out-kitchen
  rse-pf demo --data recordings/kitchen --rate 10 --robots 3 --merge --out out-merged
"""

from __future__ import annotations

import argparse
import importlib.util
import math
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.errors import MissingExtra, UsageError

__all__ = ["add_arguments", "run"]

_MAX_ROBOTS = 32
_MERGE_NEEDS = {"gtsam": "maps", "faiss": "maps", "uvicorn": "data"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--data", "--recording", type=Path, metavar="DIR", help="a recording in TUM layout, or NYU Depth V2"
    )
    parser.add_argument(
        "--robots", type=int, help="how many robots share it (default: 3; with --data and no --merge: 1)"
    )
    parser.add_argument(
        "--rate", type=float, default=5.0, metavar="HZ", help="frames per second (default: 5)"
    )
    parser.add_argument(
        "--engine", choices=("poselib", "opencv"), default="poselib", help="PnP solver (default: poselib)"
    )
    parser.add_argument(
        "--codec",
        choices=("zlib", "json", "bin"),
        default="zlib",
        help="encoding (default: zlib, the paper's)",
    )
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="results (default: out)")
    parser.add_argument(
        "--frames", type=int, help="frames of each robot in the rendered world (default: 80, to merge: 150)"
    )
    parser.add_argument("--seed", type=int, default=0, help="another rendered world (default: 0)")
    parser.add_argument(
        "--frontend", choices=("standard", "wide-baseline"), default="standard",
        help="wide-baseline: for views that lie 0.4 to 0.8 m apart, such as NYU's",
    )  # fmt: skip
    parser.add_argument(
        "--merge",
        action="store_true",
        help="end with one map of all robots; of one robot, with its loops closed",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bars")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the options and run the demo."""
    robots = (
        args.robots if args.robots is not None else (1 if args.data is not None and not args.merge else 3)
    )
    if not 1 <= robots <= _MAX_ROBOTS:
        raise UsageError(f"--robots {robots} is not within 1..{_MAX_ROBOTS}", hint="choose fewer robots")
    if not (math.isfinite(args.rate) and 0.1 <= args.rate <= 60):
        raise UsageError(f"--rate {args.rate:g} is not within 0.1..60 Hz", hint="the paper has 5")
    if args.frames is not None and not 2 <= args.frames <= 2000:
        raise UsageError(f"--frames {args.frames} is not within 2..2000", hint="80 is a path of 5.5 m")
    if args.seed < 0:
        raise UsageError(f"--seed {args.seed} is below 0", hint="choose 0 or more")
    if args.merge:
        for package, extra in _MERGE_NEEDS.items():
            if importlib.util.find_spec(package) is None:  # better now than after the drive
                raise MissingExtra(package, extra)
    from rse_pf.experiments.demo.run import DemoOptions, run_demo

    if args.data is not None:
        from client_sdk.datasets import open_dataset

        frames = len(open_dataset(args.data).thinned(args.rate).share(robots - 1, robots))
        if not frames:
            raise UsageError(f"{args.data} has too few frames for {robots} robots", hint="use fewer robots")
    options = DemoOptions(
        data=args.data,
        robots=robots,
        rate_hz=args.rate,
        engine=args.engine,
        codec=args.codec,
        out=args.out,
        frames=args.frames,
        seed=args.seed,
        frontend=args.frontend,
        merge=args.merge,
        quiet=args.quiet,
    )
    return run_demo(options, settings)
