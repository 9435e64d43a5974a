"""From load to a serving server with the delays of AWS, for the design of 0.1.0 and for this one.

    python -m benchmarks cloud.elasticity [--speed 5] [--robots 100] [--fps 5] [--folder out-as-cloud]

It runs ``rse-pf experiment elasticity --as-cloud`` and compares the medians with the bars.  At ``--speed 5``
it takes about six minutes; whatever this machine needs itself counts five times.  An estimate.

Defends: 3.5 to 5 minutes for 0.1.0, at most 75 s now.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf.config import PlatformSettings
from rse_pf.experiments.paper.elasticity import ElasticityOptions
from rse_pf.experiments.paper.elasticity_as_cloud import run_as_cloud
from rse_pf.scaling.cloud_delays import DESIGNS

__all__ = []


@benchmark(
    Bar("old.p50", at_least=3.5 * 60, unit="s"),
    Bar("old.p50", at_most=5 * 60, unit="s"),
    Bar("new.p50", at_most=75, unit="s"),
    Bar("lost", equals=0),
)
def run_benchmark(
    *, speed: float = 5.0, robots: int = 100, fps: float = 5.0,
    folder: Annotated[Path, "folder of the records"] = Path("out-as-cloud"),
) -> dict[str, Any]:  # fmt: skip
    """Run the experiment once."""
    options = ElasticityOptions(out=folder, robots=robots, fps=fps, speed=speed)
    lost = run_as_cloud(options, PlatformSettings())
    runs = json.loads((folder / "report.json").read_text(encoding="utf-8"))["runs"].values()
    times = {
        design: spread(run["serving_s"] for run in runs if run["design"] == design) for design in DESIGNS
    }
    return {**times, "lost": lost}
