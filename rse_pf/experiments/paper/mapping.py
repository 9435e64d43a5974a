"""The paper's Fig. 7 again: robots build their clouds through the platform, and their errors are measured.

It is the demo's run (real servers, real balancer, a process for each robot) with the true paths written
beside the estimated ones, so that anybody can compute the errors again.  Promises no figure of its own.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from client_sdk.mapping import Trajectory, write_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.experiments.demo.run import DemoOptions, run_demo
from rse_pf.experiments.paper.mapping_report import judge_map
from rse_pf.experiments.paper.result_folder import finish_report, policy_of
from rse_pf.experiments.results.markdown import map_markdown
from rse_pf.experiments.results.records import (
    EVENTS,
    SAMPLES,
    RecordedSample,
    SampleLog,
    ServerSample,
    asked_of,
    read_records,
)
from rse_pf.experiments.results.report import PAPER

__all__ = ["MapRunOptions", "run_map"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRunOptions:
    """What the command line says; *data* None is the rendered world."""

    out: Path
    robots: int = 3
    fps: float = 5.0
    data: Path | None = None
    frames: int = 80
    codec: str = "zlib"
    seed: int = 0


def run_map(options: MapRunOptions, settings: PlatformSettings) -> int:
    """Let the robots map, judge their files, write the report; return the exit code."""
    load_before = [round(value, 2) for value in os.getloadavg()]
    demo = DemoOptions(
        data=options.data,
        robots=options.robots,
        rate_hz=options.fps,
        codec=options.codec,
        out=options.out,
        frames=options.frames,
        seed=options.seed,
        quiet=True,
    )
    code = run_demo(demo, settings)
    folder = options.out.resolve()
    frames = _write_truth(options, folder)
    _complete_records(options, settings, folder, frames)
    records = read_records(folder)
    asked = {**asdict(options), "out": options.out.name, "data": options.data and options.data.name}
    body = {"experiment": "map", "asked": asked, **judge_map(records), "paper": PAPER}
    report = finish_report(folder, body, settings, load_before)
    (folder / "report.md").write_text(map_markdown(report), encoding="utf-8")
    print((folder / "report.md").read_text(encoding="utf-8"))
    assert asked_of(records)["kind"] == "map"
    return code


def _write_truth(options: MapRunOptions, folder: Path) -> dict[str, int]:
    """Write each robot's true path, if there is one; return how many frames each had."""
    frames = {}
    for number in range(options.robots):
        name = f"robot-{number + 1}"
        truth, frames[name] = _truth(options, number)
        if truth is not None:
            write_trajectory(folder / name / "truth.txt", truth)
    return frames


def _truth(options: MapRunOptions, number: int) -> tuple[Trajectory | None, int]:
    if options.data is None:
        from client_sdk.simulator import true_trajectory

        truth = true_trajectory(number, options.robots, options.frames, options.seed)
        return truth, options.frames
    from client_sdk.datasets import open_dataset

    share = open_dataset(options.data).thinned(options.fps).share(number, options.robots)
    return share.truth, len(share)


def _complete_records(
    options: MapRunOptions, settings: PlatformSettings, folder: Path, frames: dict[str, int]
) -> None:
    """Put what was asked before the demo's events, and its samples into the form of a monitor's."""
    first = {
        "time": 0.0,
        "action": "experiment",
        "kind": "map",
        "robots": options.robots,
        "fps": options.fps,
        "frames": frames,
        **policy_of(settings, 1.0),
    }
    events = (folder / EVENTS).read_text(encoding="utf-8")
    (folder / EVENTS).write_text(json.dumps(first) + "\n" + events, encoding="utf-8")
    with (folder / SAMPLES).open(newline="", encoding="utf-8") as file:
        readings = list(_readings(list(csv.DictReader(file))))
    with (folder / SAMPLES).open("w", newline="", encoding="utf-8") as file:
        log = SampleLog(file)
        for reading in readings:
            log.write(reading)


def _readings(rows: list[dict[str, Any]]) -> Iterator[RecordedSample]:
    """Yield a reading for each moment but the first: CPU is what was used since the one before."""
    moments: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        moments.setdefault(row["time"], {})[row["server"]] = row
    for (time_before, before), (time_s, now) in pairwise(moments.items()):
        took_s = max(float(time_s) - float(time_before), 1e-9)
        servers = tuple(_server(row, before[name], took_s) for name, row in now.items() if name in before)
        yield RecordedSample(time=float(time_s), healthy_servers=len(servers), servers=servers)


def _server(row: dict[str, Any], before: dict[str, Any], took_s: float) -> ServerSample:
    used_s = float(row["cpu_s"]) - float(before["cpu_s"])
    return ServerSample(
        server=row["server"],
        pid=int(row["pid"]),
        state="healthy",
        robots=int(row["robots"]),
        cpu_percent=round(100.0 * used_s / took_s, 2),
        requests=int(row["requests"]) - int(before["requests"]),
        queue=int(row["queue"]),
        in_flight=int(row["in_flight"]),
    )
