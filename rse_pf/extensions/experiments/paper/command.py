"""Run the experiments of the paper's Section 6 on this machine, or check a run against its raw records.

Each experiment writes report.json, report.md, commands.csv, events.jsonl, samples.csv and a figure.
--speed K divides the following times by K and no others: the joining interval, the policy's periods, idle
time and warm-up (elasticity), and the duration of faults (robustness).

examples:
  rse-pf experiment elasticity --speed 30 --robots 40 --out fig8
  rse-pf experiment live --data recordings/kitchen --fps 10 --out live
  rse-pf experiment live --only none,kill,drain --frames 310 --out live-faults
  rse-pf experiment robustness --only kill,stop --repeat 3 --out faults
  rse-pf experiment verify fig8
  rse-pf experiment verify faults --rerun
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from rse_pf.command_line.options import Action, Parser, add_action, option, perform
from rse_pf.command_line.sensors import SensorRequest
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["ACTION", "KINDS"]

T = TypeVar("T")

# Experiments of ``rse-pf experiment``, and the verification of their results.
KINDS = ("latency", "elasticity", "robustness", "map", "live", "verify")
# Default of ``--robots`` for each experiment.
_DEFAULT_ROBOTS = {"latency": 100, "elasticity": 100, "robustness": 100, "map": 3, "live": 3}
# Largest ``--robots`` of each experiment; robots of map and live run in a process each.
_MAX_ROBOTS = {"latency": 2000, "elasticity": 2000, "robustness": 2000, "map": 32, "live": 32}


@dataclass(frozen=True, kw_only=True)
class ExperimentRequest(SensorRequest):
    """Options of ``rse-pf experiment``: an experiment to run, or a folder of results to verify."""

    kind: str = option(choices=KINDS, help="the experiment, or verify")
    folder: Path | None = option(nargs="?", metavar="DIR", help="verify: results of one or more runs")
    out: Path | None = option("--out", metavar="DIR", help="folder of results (default: out-KIND)")
    rerun: bool = option(
        "--rerun",
        help="verify: also run the short form that each report holds, and list the figures it does not reach",
    )
    robots: int | None = option("--robots", metavar="N", help="robots (default: 100; map and live: 3)")
    fps: float = option("--fps", default=5.0, help="frames per second of each robot (default: 5)")
    speed: float = option("--speed", default=1.0, metavar="K", help="divide times by K (default: 1)")
    codec: str = option("--codec", choices=("zlib", "json", "bin"), default="zlib", help="default: zlib")
    seed: int = option("--seed", default=0, help="seed of problems, worlds and random faults (default: 0)")
    emulated_cores: float | None = option(
        "--emulated-cores", section="elasticity", metavar="S", help="cores of a server (default: measured)"
    )
    no_rebalance: bool = option(
        "--no-rebalance", section="elasticity", help="connected robots stay on their servers"
    )
    compare: bool = option("--compare", section="elasticity", help="with and without rebalancing, in one run")
    only: str | None = option(
        "--only",
        section="robustness and live",
        metavar="A,B",
        help="these faults (default: all but random; of a live map: none)",
    )
    repeat: int = option(
        "--repeat",
        default=1,
        section="robustness and live",
        metavar="N",
        help="runs of each fault (default: 1)",
    )
    link: str = option(
        "--link", default="paper", section="latency", help="a link profile, or none (default: paper)"
    )
    seconds: float = option(
        "--seconds", default=30.0, section="latency", help="duration with all robots (default: 30)"
    )
    data: Path | None = option(
        "--data",
        section="map and live",
        metavar="DIR",
        help="a recording (default: a rendered world)",
    )
    frames: int = option(
        "--frames",
        default=80,
        section="map and live",
        help="frames per robot, rendered world (default: 80)",
    )


def run_experiment(request: ExperimentRequest, settings: PlatformSettings) -> int:
    """Check the options and run the experiment or the verification; return the exit code."""
    if request.kind == "verify":
        folder = request.folder if request.folder is not None else request.out
        if folder is None:
            raise UsageError("verify needs a folder", hint="rse-pf experiment verify DIR")
        return max(_verify(folder), _rerun(folder, settings) if request.rerun else 0)
    if request.rerun:
        raise UsageError("--rerun is for verify", hint="rse-pf experiment verify DIR --rerun")
    if request.folder is not None:
        raise UsageError(
            f"{request.kind} takes no folder", hint=f"name the results with --out {request.folder}"
        )
    robots = _DEFAULT_ROBOTS[request.kind] if request.robots is None else request.robots
    request = replace(request, out=request.out or Path(f"out-{request.kind}"), robots=robots)
    _check(request)
    return {
        "elasticity": _elasticity,
        "latency": _latency,
        "robustness": _robustness,
        "map": _map,
        "live": _live,
    }[request.kind](request, settings)


def _check(request: ExperimentRequest) -> None:
    limits = (
        ("--robots", request.robots, 1, _MAX_ROBOTS[request.kind], "the paper uses 100"),
        ("--fps", request.fps, 0.1, 60, "the paper uses 5"),
        ("--speed", request.speed, 1, 100, "1 takes as long as the paper; 30 suits CI"),
        ("--seconds", request.seconds, 1, 3600, "30 is enough for percentiles"),
        ("--emulated-cores", request.emulated_cores, 0.001, 64, "leave it out to measure it"),
        ("--repeat", request.repeat, 1, 20, "3 shows the spread"),
        ("--frames", request.frames, 2, 2000, "80 frames are a path of 5.5 m"),
    )
    for name, value, low, high, hint in limits:
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            raise UsageError(f"{name} {value:g} is not within {low:g}..{high:g}", hint=hint)
    if request.seed < 0:
        raise UsageError(f"--seed {request.seed} is below 0", hint="choose 0 or more")


def _elasticity(request: ExperimentRequest, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.paper.elasticity import ElasticityOptions, run_elasticity

    if settings.scaling.period_s / request.speed < 0.5:
        raise UsageError(
            f"--speed {request.speed:g} makes a period of the policy shorter than 0.5 s",
            hint=f"use at most {2 * settings.scaling.period_s}",
        )
    return run_elasticity(_options(ElasticityOptions, request, rebalance=not request.no_rebalance), settings)


def _latency(request: ExperimentRequest, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.faults.network_emulator import profile_named
    from rse_pf.extensions.experiments.paper.latency import LatencyOptions, run_latency

    link = None if request.link == "none" else profile_named(request.link).name
    return run_latency(_options(LatencyOptions, request, link=link), settings)


def _robustness(request: ExperimentRequest, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.paper.fault_scenarios import SCENARIOS
    from rse_pf.extensions.experiments.paper.robustness import RobustnessOptions, run_robustness

    return run_robustness(
        _options(RobustnessOptions, request, only=_faults(request.only, SCENARIOS)), settings
    )


def _faults(only: str | None, known: Collection[str]) -> tuple[str, ...]:
    """Return the fault names in *only*, the comma-separated value of ``--only``, without duplicates.

    Raises:
        UsageError: A name is not in *known*.
    """
    chosen = tuple(dict.fromkeys(word for word in (only or "").split(",") if word))
    for word in chosen:
        if word not in known:
            raise UsageError(f"there is no fault {word!r}", hint=f"known are {', '.join(known)}")
    return chosen


def _map(request: ExperimentRequest, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.demo.run import DemoOptions
    from rse_pf.extensions.experiments.paper.mapping import run_map

    return run_map(_options(DemoOptions, request, rate_hz=request.fps, quiet=True), settings)


def _live(request: ExperimentRequest, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.demo.run import DemoOptions
    from rse_pf.extensions.experiments.paper.live_faults import LIVE_FAULTS, run_live_faults
    from rse_pf.extensions.experiments.paper.live_map import run_live

    options = _options(DemoOptions, request, rate_hz=request.fps, live=True, quiet=True)
    only = _faults(request.only, LIVE_FAULTS)
    return run_live_faults(options, settings, only, request.repeat) if only else run_live(options, settings)


def _options(kind: type[T], request: ExperimentRequest, **changed: Any) -> T:
    """Return a *kind* whose fields have the values of *request* of the same names, or those of *changed*."""
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    given = {name: value for name, value in vars(request).items() if name in known}
    return kind(**{**given, **changed})


def _verify(folder: Path) -> int:
    from rse_pf.extensions.experiments.paper.verify import verify

    checks = verify(folder)
    for check in checks:
        show(str(check))
    checked = sum(check.agrees is not None for check in checks)
    differing = sum(check.agrees is False for check in checks)
    skipped = f", {len(checks) - checked} skipped" if checked < len(checks) else ""
    show(f"{checked} figures and invariants checked, {differing} differ{skipped}")
    return int(differing > 0)


def _rerun(folder: Path, settings: PlatformSettings) -> int:
    """Run the short form of each experiment in *folder*.

    Return 1 if it missed a figure of a report, else 0.
    """
    from rse_pf.extensions.experiments.paper.verify import read_report, report_folders
    from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_arguments, rerun_figures

    missed = 0
    for part in report_folders(folder):
        report = read_report(part)
        if RERUN not in report:
            show(f"skipped  {part.name}: the report has no short form")
            continue
        words = rerun_arguments(report)
        show(f"rse-pf experiment {' '.join(words)}")
        with tempfile.TemporaryDirectory(prefix="rse-pf-rerun-") as place:
            out = Path(place) / "short"
            perform(_parse_short_form([*words, "--out", str(out)]), settings)
            figures = rerun_figures(report, read_report(out))
        for figure in figures:
            show(f"{part.name}: {figure}" if part != folder else str(figure))
        missed += sum(not figure.is_reached for figure in figures)
    show(
        f"{missed} figures of the reports are not reached by this version"
        if missed
        else "all figures are reached"
    )
    return int(missed > 0)


def _parse_short_form(words: list[str]) -> argparse.Namespace:
    """Parse *words*, the arguments of a short run from a report; raises UsageError if they are damaged."""
    parser = Parser(add_help=False)
    add_action(parser, ACTION)
    try:
        return parser.parse_args(words)
    except UsageError as error:
        raise UsageError(
            f"the short form in the report is damaged: {error.message}", hint="restore the report"
        ) from error


ACTION = Action(request=ExperimentRequest, run=run_experiment)
