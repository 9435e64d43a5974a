"""Compare configurations of the tracker on recordings: accuracy, lost frames, bytes and CPU time.

CONFIG is built in (default, live, wide-baseline, without-depth, features-500), a file NAME.toml or NAME.py
with options and functions of your own, or module:function for features.  A recording is a folder in the
layout of TUM, EuRoC or KITTI, NYU Depth V2, a ROS bag, or world:SEED, which is rendered.  Poses are solved in
this process, so that every run gives the same result.

examples:
  rse-pf compare --data world:3
  rse-pf compare default features-500 mine.py --data recordings/kitchen --rate 10 5 --out out-compare
  rse-pf compare --data recordings/MH_01 --camera left --no-imu
  rse-pf compare default without-depth --data recordings/kitchen recordings/MH_01 --runs 3
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from client_sdk.source_facts import check_accepted
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.command_line.sensors import AcceptRequest, SensorRequest
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError

__all__ = ["ACTION"]

# Largest ``--runs``: repetitions of each run.
_MAX_RUNS = 100


@dataclass(frozen=True, kw_only=True)
class CompareRequest(SensorRequest, AcceptRequest):
    """Options of ``rse-pf compare``: configurations of the tracker, and the recordings to track with them."""

    configs: tuple[str, ...] = option(
        nargs="*",
        default=("default",),
        metavar="CONFIG",
        help="a name, NAME.toml, NAME.py or MODULE:FUNCTION (default: default)",
    )
    data: tuple[str, ...] = option(
        "--data",
        "--recording",
        nargs="+",
        required=True,
        metavar="RECORDING",
        help="folders, ROS bags, or world:SEED",
    )
    rate: tuple[float, ...] = option(
        "--rate",
        nargs="+",
        default=(),
        metavar="HZ",
        help="frames per second; several rates play each recording several times (default: all frames)",
    )
    runs: int = option(
        "--runs", default=1, metavar="N", help="repeat each run N times, and show the spread (default: 1)"
    )
    out: Path = option(
        "--out", default=Path("out-compare"), metavar="DIR", help="folder of results (default: out-compare)"
    )
    platform: bool = option(
        "--platform", help="solve the poses by a platform that is started on this machine"
    )


def compare(request: CompareRequest, settings: PlatformSettings) -> int:
    """Check the options and run the comparison; return the exit code."""
    if not 1 <= request.runs <= _MAX_RUNS:
        raise UsageError(f"--runs {request.runs} is not within 1..{_MAX_RUNS}", hint="3 show a spread")
    for rate_hz in request.rate:
        if not (math.isfinite(rate_hz) and 0.1 <= rate_hz <= 1000):
            raise UsageError(
                f"--rate {rate_hz:g} is not within 0.1..1000 Hz", hint="leave it out to play all frames"
            )
    check_accepted(request.accept)
    require("compare")
    from rse_pf.extensions.experiments.compare.configurations import configurations_of
    from rse_pf.extensions.experiments.compare.recordings import drives_of
    from rse_pf.extensions.experiments.compare.run import CompareOptions, run_compare

    options = CompareOptions(
        configurations=configurations_of(request.configs),
        drives=drives_of(request.data, request.rate, camera=request.camera, imu=request.imu),
        runs=request.runs, out=request.out, platform=request.platform,
        accepted=request.accept,
    )  # fmt: skip
    return run_compare(options, settings)


ACTION = Action(request=CompareRequest, run=compare)
