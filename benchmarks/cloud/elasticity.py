"""From load to a serving server with the delays of AWS, for the design of 0.1.0 and for this one.

    python -m benchmarks.cloud.elasticity [--speed 5] [--robots 100] [--fps 5] [--out out-as-cloud]

It runs ``rse-pf experiment elasticity --as-cloud`` and compares the medians with the bars.  At ``--speed 5``
it takes about six minutes; whatever this machine needs itself counts five times.  An estimate.

Defends: 3.5 to 5 minutes for 0.1.0, at most 75 s now.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.experiments.paper.elasticity import ElasticityOptions
from rse_pf.experiments.paper.elasticity_as_cloud import run_as_cloud
from rse_pf.scaling.cloud_delays import DESIGNS

__all__ = ["main"]

BARS_S = {"0.1.0": (210.0, 300.0), "now": (0.0, 75.0)}


def main(arguments: list[str] | None = None) -> int:
    """Run once; return 1 if a bar is missed or a command was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--speed", type=float, default=5.0)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--fps", type=float, default=5.0)
    parser.add_argument("--out", type=Path, default=Path("out-as-cloud"))
    args = parser.parse_args(arguments)
    options = ElasticityOptions(out=args.out, robots=args.robots, fps=args.fps, speed=args.speed)
    lost = run_as_cloud(options, PlatformSettings())
    runs = json.loads((args.out / "report.json").read_text(encoding="utf-8"))["runs"].values()
    missed = 0
    for design in DESIGNS:
        low_s, high_s = BARS_S[design]
        times = [run["serving_s"] for run in runs if run["design"] == design]
        median_s = statistics.median(times)
        holds = low_s <= median_s <= high_s
        missed += not holds
        print(f"{design}: median {median_s:g} s of {times}; bar {low_s:g} to {high_s:g} s: {holds}")
    return int(bool(missed or lost))


if __name__ == "__main__":
    raise SystemExit(main())
