"""Faults of a live map, end to end: two servers behind the load balancer, three robots in the rendered world.

    python -m benchmarks.live.faults none | kill | stop | drain | roll | store | wifi [--seed N]

One run takes about 75 s after the world was rendered once (five minutes,
`benchmarks.live.rendered_recording`).
Three robots drive 62 s at 5 Hz through three rooms; the fault comes at a moment that the seed draws:
``kill -9`` of the owner's server, SIGSTOP of all its processes for 10 s, a drain, a rolling replacement, 30 %
of all operations on the store failing for 10 s, 30 s without Wi-Fi of one robot.  Prints one row of a table
and the figures as JSON, and keeps all records in --out: ``rse-pf experiment verify OUT`` recomputes them.

Defends: no acknowledged keyframe lost or twice, no frame lost, a new owner within 3 s, the map equal to the
byte to a replay of its own log, and its error within 0.3 cm of runs without a fault.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks.live.rendered_recording import write_recording
from rse_pf.config import PlatformSettings
from rse_pf.experiments.demo.live_faults import LIVE_FAULTS, LiveFault
from rse_pf.experiments.demo.run import DemoOptions
from rse_pf.experiments.paper.live_faults import run_live_fault
from rse_pf.experiments.results.live_faults import fault_rows
from rse_pf.experiments.results.markdown import table

__all__ = ["main"]

ROBOTS, RATE_HZ, FRAMES = 3, 5.0, 310


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one fault, and print its figures beside those of runs that are in the same folder."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live.faults")
    parser.add_argument("fault", choices=LIVE_FAULTS)
    parser.add_argument("--seed", type=int, default=0, help="draws the moment of the fault")
    parser.add_argument("--world", type=Path, default=Path("out-rendered-world"))
    parser.add_argument("--out", type=Path, default=Path("out-live-faults"))
    chosen = parser.parse_args(arguments)
    world = write_recording(chosen.world, ROBOTS, FRAMES, seed=0)
    chosen.out.mkdir(parents=True, exist_ok=True)
    name = f"{chosen.fault}-{chosen.seed}"
    options = DemoOptions(
        data=world, robots=ROBOTS, rate_hz=RATE_HZ, out=chosen.out / name, live=True, quiet=True
    )
    load = os.getloadavg()[0]
    figures = run_live_fault(options, PlatformSettings(), LiveFault(name=chosen.fault, seed=chosen.seed))
    figures["load_average"] = [round(load, 2), round(os.getloadavg()[0], 2)]
    report_file = chosen.out / "report.json"
    report = json.loads(report_file.read_text(encoding="utf-8")) if report_file.exists() else {"runs": {}}
    runs = report["runs"]
    runs[name] = figures
    report_file.write_text(
        json.dumps({"experiment": "live", "runs": runs}, indent=1) + "\n", encoding="utf-8"
    )
    undisturbed = {other: run for other, run in runs.items() if run["fault"] == "none" and other != name}
    rows = fault_rows({**undisturbed, name: figures})
    print(json.dumps(figures))
    print("\n".join(table(rows[0], rows[-1:])))


if __name__ == "__main__":
    main()
