"""From load to a serving server with the cloud's own delays: the design of 0.1.0, and this one.

All robots drive at once, two servers are too few, and the clock runs until a third one serves.  The policy,
its periods, the health checks and the robots are real; the delays of `rse_pf.scaling.cloud_delays` are
played, compressed by ``--speed`` as the periods are.  The result is an estimate: nothing was measured on AWS.
"""

from __future__ import annotations

import asyncio
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.paper.elasticity import ElasticityOptions, emulated_cores
from rse_pf.experiments.paper.harness import Harness, generator_of
from rse_pf.experiments.results.markdown import about_run, failures, number, page, table, three
from rse_pf.experiments.results.records import Records, parameters_of, read_records
from rse_pf.experiments.results.result_folder import RUN_FILES, finish_report, fresh_folder, load_average
from rse_pf.experiments.results.summary import summary_of
from rse_pf.scaling.cloud_delays import DESIGNS, Design
from rse_pf.scaling.profile import cadence_of
from rse_pf.terminal import show, show_page

__all__ = ["KIND", "as_cloud_figures", "as_cloud_page", "run_as_cloud"]

KIND = "elasticity-as-cloud"
_LOAD_SHARE = 0.6
"""Of the robots that need five servers at 70 %: two servers are then at about 95 %."""
_PHASES = (0.15, 0.5, 0.85)
"""Where in a period the load begins; it decides how long the alarm takes."""
_SERVERS = 2
_TIMEOUT_FACTOR = 3.0


def run_as_cloud(options: ElasticityOptions, settings: PlatformSettings) -> int:
    """Run both designs, write records and report; return 1 if a command was lost or duplicated."""
    names = [f"{design}-{number}" for design in DESIGNS for number in range(1, len(_PHASES) + 1)]
    folder = fresh_folder(options.out, [*RUN_FILES, *names, "calibration"])
    load_before = load_average()
    cores, _ = asyncio.run(emulated_cores(options, settings, folder))
    for design_name, design in DESIGNS.items():
        chosen = settings.replace(
            serving={"emulated_cores": cores}, local={"servers": _SERVERS},
            scaling={
                "profile": design.profile, "warm_up_s": design.warm_up_s, "min_servers": _SERVERS,
                "max_servers": max(settings.scaling.max_servers, _SERVERS + 1), "schedule": "",
            },
        )  # fmt: skip
        for at, phase in enumerate(_PHASES, 1):
            part = folder / f"{design_name}-{at}"
            part.mkdir()
            asyncio.run(_run(options, chosen, part, design_name, design, phase))
    records = {name: read_records(folder / name) for name in names}
    runs = {name: as_cloud_figures(record) for name, record in records.items()}
    report = {
        "experiment": KIND,
        "asked": {"robots": options.robots, "fps": options.fps, "speed": options.speed, "out": folder.name},
        "size": cores,
        "delays": {name: _delays(design) for name, design in DESIGNS.items()},
        "runs": runs,
        "generator": {name: generator_of(record) for name, record in records.items()},
    }
    show_page(finish_report(folder, report, as_cloud_page, settings, load_before))
    show(f"wrote report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in runs.values()))


def as_cloud_figures(records: Records) -> dict[str, Any]:
    """Return the figures of one run; times are seconds of the cloud, from the moment the first robot drives.

    Raises:
        UsageError: The events do not hold the parameters of the run.
    """
    parameters, summary = parameters_of(records), summary_of(records)
    speed = float(parameters["speed"])

    def after(action: str, since_s: float) -> float | None:
        times = (float(event["time"]) for event in records.events if event["action"] == action)
        return next((at for at in times if at >= since_s), None)

    loaded_s = after("robot-joined", 0.0) or 0.0
    grown_s = after("grow", loaded_s)
    served_s = None if grown_s is None else after("server-healthy", grown_s)
    return {
        "design": parameters["design"],
        "begins_at": parameters["begins_at"],
        "decided_s": None if grown_s is None else round((grown_s - loaded_s) * speed, 1),
        "serving_s": None if served_s is None else round((served_s - loaded_s) * speed, 1),
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "round_trip_ms": summary["round_trip_ms"],
    }


def as_cloud_page(report: Mapping[str, Any]) -> str:
    """Return ``report.md``."""
    asked, runs = report["asked"], report["runs"]
    steps = [
        [name, delay["step"], _range(delay), delay["source"]]
        for name, delays in report["delays"].items()
        for delay in delays
    ]
    rows = [
        [
            name, f"{run['begins_at']:g}", number(run["decided_s"]), number(run["serving_s"]),
            failures(run), three(run["round_trip_ms"]),
        ]
        for name, run in runs.items()
    ]  # fmt: skip
    medians = "; ".join(
        f"{design}: {number(_median(runs, design))} s from load to serving (median of {len(_PHASES)})"
        for design in report["delays"]
    )
    return page(
        "# RSE-PF experiment: elasticity with the cloud's delays",
        "An **estimate**: the policy, its periods, the health checks and the robots ran on one machine; the "
        "delays below were played, each at the middle of its range, and nothing was measured on AWS.",
        f"{round(asked['robots'] * _LOAD_SHARE)} robots x {asked['fps']:g} fps drive at once on {_SERVERS} "
        f"servers of {report['size']:g} emulated cores; time compressed {asked['speed']:g}x, so that what "
        f"this machine needs itself counts {asked['speed']:g} times.",
        f"{medians}.",
        table(["design", "step", "s", "source"], steps),
        table(
            [
                "run", "load begins at (share of a period)", "decided after, s", "serving after, s",
                "failed, by code", "round trip p50 / p95 / p99 ms",
            ],
            rows,
        ),
        about_run(report),
    )  # fmt: skip


async def _run(
    options: ElasticityOptions,
    settings: PlatformSettings,
    folder: Path,
    name: str,
    design: Design,
    phase: float,
) -> None:
    """Load two servers at *phase* of a period, and wait until a third one serves."""
    speed = options.speed
    period_s = cadence_of(settings.scaling).period_s / speed
    robots = max(1, round(options.robots * _LOAD_SHARE))
    parameters = {
        "kind": KIND, "design": name, "begins_at": phase, "robots": robots, "fps": options.fps,
        "speed": speed,
    }  # fmt: skip
    async with Harness(
        folder, settings, parameters, compress=speed, rebalance=design.rebalances, delays=design.delays
    ) as harness:
        asked = LoadScenario(robots=robots, fps=options.fps, codec=options.codec, seed=options.seed)
        async with harness.swarm(asked) as swarm:
            await harness.run_for(max(period_s, settings.scaling.warm_up_s / speed))
            await harness.run_for(_until_phase(time.monotonic(), period_s, phase))
            await swarm.start()
            await swarm.wait_joined(60.0)
            began_s = harness.now()
            show(f"{name}: {robots} robots drive")
            longest_s = (design.delays.metrics_s + design.delays.launch_s) / speed + 4 * period_s

            def serves() -> bool:
                grown = harness.events_since("grow", began_s)
                return bool(grown and harness.events_since("server-healthy", grown[0]["time"]))

            if not await harness.wait_for(serves, _TIMEOUT_FACTOR * longest_s + 20.0):
                raise CommandFailed(
                    f"{name}: no further server serves after {harness.now() - began_s:.0f} s",
                    hint=f"look at the events in {folder}; raise --robots or lower --speed",
                )
            show(
                f"{name}: a third server serves after {(harness.now() - began_s) * speed:.0f} s of the cloud"
            )
            await harness.run_for(1.0)
            await swarm.leave()
            await harness.save_result(await swarm.finish())


def _until_phase(now_s: float, period_s: float, phase: float) -> float:
    """Return how long it is until the share *phase* of a period has passed."""
    return math.fmod(phase * period_s - math.fmod(now_s, period_s) + 2 * period_s, period_s)


def _delays(design: Design) -> list[dict[str, Any]]:
    return [
        {"step": stage.step, "low_s": stage.low_s, "high_s": stage.high_s, "source": stage.source}
        for stage in (design.metrics, *design.launch)
    ]


def _range(delay: Mapping[str, Any]) -> str:
    low, high = delay["low_s"], delay["high_s"]
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _median(runs: Mapping[str, Mapping[str, Any]], design: str) -> float | None:
    times: Sequence[float] = [
        run["serving_s"] for run in runs.values() if run["design"] == design and run["serving_s"] is not None
    ]
    return round(statistics.median(times), 1) if times else None
