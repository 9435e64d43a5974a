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
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from rse_pf.command_line.sensors import add_sensor_arguments
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["KINDS", "add_arguments", "run"]

T = TypeVar("T")

KINDS = ("latency", "elasticity", "robustness", "map", "live", "verify")
_ROBOTS = {"latency": 100, "elasticity": 100, "robustness": 100, "map": 3, "live": 3}
_MAX_ROBOTS = {"latency": 2000, "elasticity": 2000, "robustness": 2000, "map": 32, "live": 32}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("kind", choices=KINDS, help="the experiment, or verify")
    parser.add_argument(
        "folder", nargs="?", type=Path, metavar="DIR", help="verify: results of one or more runs"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of results (default: out-KIND)")
    parser.add_argument(
        "--rerun", action="store_true",
        help="verify: also run the short form that each report holds, and name the figures it does not reach",
    )  # fmt: skip
    parser.add_argument("--robots", type=int, metavar="N", help="robots (default: 100; map and live: 3)")
    parser.add_argument("--fps", type=float, default=5.0, help="frames per second of each robot (default: 5)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="K", help="compress times (default: 1)")
    parser.add_argument("--codec", choices=("zlib", "json", "bin"), default="zlib", help="default: zlib")
    parser.add_argument("--seed", type=int, default=0, help="seed of problems, worlds and random faults")
    elasticity = parser.add_argument_group("elasticity")
    elasticity.add_argument(
        "--emulated-cores", type=float, metavar="S", help="cores of a server (default: measured)"
    )
    elasticity.add_argument(
        "--no-rebalance", action="store_true", help="connected robots stay on their servers"
    )
    elasticity.add_argument("--compare", action="store_true", help="with and without rebalancing, in one run")
    robustness = parser.add_argument_group("robustness and live")
    robustness.add_argument(
        "--only", metavar="A,B", help="these faults (default: all but random; of a live map: none)"
    )
    robustness.add_argument(
        "--repeat", type=int, default=1, metavar="N", help="runs of each fault (default: 1)"
    )
    latency = parser.add_argument_group("latency")
    latency.add_argument("--link", default="paper", help="a link profile, or none (default: paper)")
    latency.add_argument("--seconds", type=float, default=30.0, help="duration with all robots (default: 30)")
    mapping = parser.add_argument_group("map and live")
    mapping.add_argument("--data", type=Path, metavar="DIR", help="a recording (default: a rendered world)")
    add_sensor_arguments(mapping)
    mapping.add_argument(
        "--frames", type=int, default=80, help="frames per robot, rendered world (default: 80)"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the options and run the experiment."""
    if args.kind == "verify":
        folder = args.folder if args.folder is not None else args.out
        return max(_verify(folder), _rerun(folder, settings) if args.rerun else 0)
    if args.rerun:
        raise UsageError("--rerun is for verify", hint="rse-pf experiment verify DIR --rerun")
    if args.folder is not None:
        raise UsageError(f"{args.kind} takes no folder", hint=f"name the results with --out {args.folder}")
    if args.out is None:
        args.out = Path(f"out-{args.kind}")
    if args.robots is None:
        args.robots = _ROBOTS[args.kind]
    _check(args)
    return {
        "elasticity": _elasticity,
        "latency": _latency,
        "robustness": _robustness,
        "map": _map,
        "live": _live,
    }[args.kind](args, settings)


def _check(args: argparse.Namespace) -> None:
    limits = (
        ("--robots", args.robots, 1, _MAX_ROBOTS[args.kind], "the paper uses 100"),
        ("--fps", args.fps, 0.1, 60, "the paper uses 5"),
        ("--speed", args.speed, 1, 100, "1 takes as long as the paper; 30 suits CI"),
        ("--seconds", args.seconds, 1, 3600, "30 is enough for percentiles"),
        ("--emulated-cores", args.emulated_cores, 0.001, 64, "leave it out to measure it"),
        ("--repeat", args.repeat, 1, 20, "3 shows the spread"),
        ("--frames", args.frames, 2, 2000, "80 is a path of 5.5 m"),
    )
    for name, value, low, high, hint in limits:
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            raise UsageError(f"{name} {value:g} is not within {low:g}..{high:g}", hint=hint)
    if args.seed < 0:
        raise UsageError(f"--seed {args.seed} is below 0", hint="choose 0 or more")


def _elasticity(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.paper.elasticity import ElasticityOptions, run_elasticity

    if settings.scaling.period_s / args.speed < 0.5:
        raise UsageError(
            f"--speed {args.speed:g} makes a period of the policy shorter than 0.5 s",
            hint=f"use at most {2 * settings.scaling.period_s}",
        )
    return run_elasticity(_options(ElasticityOptions, args, rebalance=not args.no_rebalance), settings)


def _latency(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.paper.latency import LatencyOptions, run_latency
    from rse_pf.local.faults.network_emulator import profile_named

    link = None if args.link == "none" else profile_named(args.link).name
    return run_latency(_options(LatencyOptions, args, link=link), settings)


def _robustness(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.paper.fault_scenarios import SCENARIOS
    from rse_pf.extensions.experiments.paper.robustness import RobustnessOptions, run_robustness

    return run_robustness(_options(RobustnessOptions, args, only=_faults(args.only, SCENARIOS)), settings)


def _faults(only: str | None, known: Collection[str]) -> tuple[str, ...]:
    """Return the faults that the option ``--only`` names; raises UsageError for one that is none."""
    chosen = tuple(dict.fromkeys(word for word in (only or "").split(",") if word))
    for word in chosen:
        if word not in known:
            raise UsageError(f"there is no fault {word!r}", hint=f"known are {', '.join(known)}")
    return chosen


def _map(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.demo.run import DemoOptions
    from rse_pf.extensions.experiments.paper.mapping import run_map

    return run_map(_options(DemoOptions, args, rate_hz=args.fps, quiet=True), settings)


def _live(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.extensions.experiments.demo.run import DemoOptions
    from rse_pf.extensions.experiments.paper.live_faults import LIVE_FAULTS, run_live_faults
    from rse_pf.extensions.experiments.paper.live_map import run_live

    options = _options(DemoOptions, args, rate_hz=args.fps, live=True, quiet=True)
    only = _faults(args.only, LIVE_FAULTS)
    return run_live_faults(options, settings, only, args.repeat) if only else run_live(options, settings)


def _options(kind: type[T], args: argparse.Namespace, **changed: Any) -> T:
    """Return the options of an experiment: its fields by their names on the command line."""
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    given = {name: value for name, value in vars(args).items() if name in known}
    return kind(**{**given, **changed})


def _verify(folder: Path | None) -> int:
    from rse_pf.extensions.experiments.paper.verify import verify

    if folder is None:
        raise UsageError("verify needs a folder", hint="rse-pf experiment verify DIR")
    checks = verify(folder)
    for check in checks:
        show(str(check))
    checked = sum(check.agrees is not None for check in checks)
    differing = sum(check.agrees is False for check in checks)
    skipped = f", {len(checks) - checked} skipped" if checked < len(checks) else ""
    show(f"{checked} figures and invariants checked, {differing} differ{skipped}")
    return int(differing > 0)


def _rerun(folder: Path, settings: PlatformSettings) -> int:
    """Run the short form of each experiment in *folder*; return 1 if a figure was not reached."""
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
            run(_Parser.parsed([*words, "--out", str(out)]), settings)
            figures = rerun_figures(report, read_report(out))
        for figure in figures:
            show(f"{part.name}: {figure}" if part != folder else str(figure))
        missed += sum(not figure.is_reached for figure in figures)
    show(f"{missed} figures of the reports are not reached by this version" if missed else "all are reached")
    return int(missed > 0)


class _Parser(argparse.ArgumentParser):
    """The arguments in a report, which may be damaged."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"the short form in the report is damaged: {message}", hint="restore it")

    @classmethod
    def parsed(cls, words: list[str]) -> argparse.Namespace:
        parser = cls(add_help=False)
        add_arguments(parser)
        return parser.parse_args(words)
