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

import math
from dataclasses import dataclass
from pathlib import Path

from client_sdk.source_facts import check_accepted, unresolved
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.command_line.sensors import CheckRequest, SensorRequest, show_source
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.recording.writer import with_recordings
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]

# Largest ``--robots``: every robot is a process.
_MAX_ROBOTS = 32


@dataclass(frozen=True, kw_only=True)
class DemoRequest(SensorRequest, CheckRequest):
    """Options of ``rse-pf demo``: the recording or rendered world, the tracking, and the use of the maps."""

    data: Path | None = option(
        "--data",
        "--recording",
        metavar="DIR",
        help="a recording in the layout of TUM, EuRoC or KITTI, NYU Depth V2, or a ROS bag",
    )
    robots: int | None = option(
        "--robots",
        help="robots that share the recording (default: 3; with --data, but neither --merge nor --live: 1)",
    )
    rate: float = option(
        "--rate",
        default=5.0,
        metavar="HZ",
        help="frames per second; the rate of the recording plays all of its frames (default: 5)",
    )
    engine: str = option(
        "--engine", choices=("native", "opencv"), default="native", help="PnP solver (default: native)"
    )
    codec: str = option(
        "--codec",
        choices=("zlib", "json", "bin"),
        default="zlib",
        help="encoding of commands (default: zlib, as in the paper)",
    )
    out: Path = option("--out", default=Path("out"), metavar="DIR", help="folder of results (default: out)")
    frames: int | None = option(
        "--frames",
        help="frames per robot in the rendered world (default: 80; more with --merge or --live)",
    )
    seed: int = option("--seed", default=0, help="seed of the rendered world (default: 0)")
    frontend: str = option(
        "--frontend",
        choices=("standard", "wide-baseline"),
        default="standard",
        help="wide-baseline: for frames that are 0.4 to 0.8 m apart, such as those of NYU",
    )
    features: str | None = option(
        "--features",
        metavar="MODULE:FUNCTION",
        help="find features with this function instead of ORB: see docs/own_parts.md",
    )
    merge: bool = option(
        "--merge", help="merge the maps of all robots at the end; of one robot, close its loops"
    )
    live: bool = option("--live", help="all robots build one live map, and correct each other at once")
    record: Path | None = option(
        "--record",
        metavar="DIR",
        help="record the messages of robots and servers in DIR, for rse-pf replay (recording.folder)",
    )
    quiet: bool = option("--quiet", help="show no progress bars")


def demo(request: DemoRequest, settings: PlatformSettings) -> int:
    """Check the options and the recording, show the findings about it, and run the demo.

    Return the exit code.
    """
    robots = (
        request.robots
        if request.robots is not None
        else (1 if request.data is not None and not (request.merge or request.live) else 3)
    )
    if not 1 <= robots <= _MAX_ROBOTS:
        hint = "choose at least one robot" if robots < 1 else "choose fewer robots"
        raise UsageError(f"--robots {robots} is not within 1..{_MAX_ROBOTS}", hint=hint)
    if not (math.isfinite(request.rate) and 0.1 <= request.rate <= 60):
        raise UsageError(
            f"--rate {request.rate:g} is not within 0.1..60 Hz",
            hint="5 is the paper's; most recordings have 30",
        )
    if request.frames is not None and not 2 <= request.frames <= 2000:
        raise UsageError(
            f"--frames {request.frames} is not within 2..2000", hint="80 frames are a path of 5.5 m"
        )
    if request.frames is not None and request.data is not None:
        raise UsageError(
            "--frames is for the rendered world: a recording is played whole",
            hint="play fewer of its frames with --rate, or leave out one of them",
        )
    if request.seed < 0:
        raise UsageError(f"--seed {request.seed} is below 0", hint="choose 0 or more")
    if request.live and request.merge:
        raise UsageError("--live and --merge exclude each other", hint="a live map needs no merge")
    require("demo --merge" if request.merge else "demo --live" if request.live else "demo")
    from client_sdk.plugins import load_features

    load_features(request.features)
    settings = with_recordings(settings, request.record)
    from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo

    shown: tuple[str, ...] = ()
    if request.data is not None:
        from client_sdk.datasets import open_dataset

        check_accepted(request.accept)
        dataset = open_dataset(request.data, camera=request.camera, imu=request.imu)
        dataset.check()
        shown = show_source(dataset.notes, unresolved(dataset.log.doubts, request.accept))
        thinned = dataset.thinned(request.rate)
        if len(thinned) < len(dataset):
            show(
                f"note: {len(thinned)} of {counted(len(dataset), 'frame')} are played "
                f"at --rate {request.rate:g}"
            )
        frames = len(thinned.share(robots - 1, robots))
        if not frames:
            raise UsageError(
                f"{request.data} has too few frames for {robots} robots", hint="use fewer robots"
            )
    options = DemoOptions(
        data=request.data,
        camera=request.camera,
        imu=request.imu,
        robots=robots,
        rate_hz=request.rate,
        engine=request.engine,
        codec=request.codec,
        out=request.out,
        frames=request.frames,
        seed=request.seed,
        frontend=request.frontend,
        features=request.features,
        merge=request.merge,
        live=request.live,
        quiet=request.quiet,
        check=request.check,
        accepted=request.accept,
        shown=shown,
    )
    return run_demo(options, settings)


ACTION = Action(request=DemoRequest, run=demo)
