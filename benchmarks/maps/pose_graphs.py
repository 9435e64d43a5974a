"""Our ``optimise`` beside g2o's own optimiser, on the sphere and on the graph of the kitchen's merge.

    python -m benchmarks maps.pose_graphs VENV/bin/python [--recordings DIR]

*VENV* has ``g2o-python`` and ``numpy<2``; see `g2o_reference.py`, which runs there.  Both fit the same text
with the same Cauchy kernel from the same start, ours once more from the chordal start; each is judged by our
chi2 and our robust cost at its poses, and its trajectory by the truth.  Times are those of the optimisers
alone, ours with the making of gtsam's graph.

Defends: chi2 not above g2o's by more than 0.1 %, trajectory error within 10 % of g2o's, 5 s.
"""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.maps.services import robots_of
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array
from rse_pf.slam import map_merge as join
from rse_pf.slam.map_merge import merge_versions
from rse_pf.slam.optimise import OptimisedGraph, OptimiseOptions, optimise_graph, robust_cost
from rse_pf.slam.pose_graph import PoseGraph, write_g2o
from tests.synthetic_maps import make_sphere

REFERENCE = Path(__file__).with_name("g2o_reference.py")
CAUCHY = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    g2o_python: Annotated[Path, "interpreter with g2o and numpy 1"]
    recordings: Annotated[Path | None, "folder of recordings, for the kitchen's graph"] = None
    rounds: Annotated[int, "of g2o"] = 60


def kitchen_graph(recordings: Path) -> tuple[PoseGraph, Array]:
    """Return the graph that a merge of the kitchen's three robots optimises, and its true poses."""
    robots = robots_of(recordings)
    seen: list[PoseGraph] = []

    def watch(graph: PoseGraph, options: OptimiseOptions | None = None, **others: Any) -> OptimisedGraph:
        seen.append(graph)
        return optimise_graph(graph, options, **others)

    join.optimise_graph, before = watch, join.optimise_graph
    try:
        merged = merge_versions([run.version for run in robots.runs])
    finally:
        join.optimise_graph = before
    truth = {
        (f"robot-{number}", round(stamp, 6)): pose
        for number, (run, first) in enumerate(zip(robots.runs, firsts(robots.runs), strict=True))
        for stamp, pose in zip(run.stamps_s, robots.truth[first:], strict=False)
    }
    poses = [truth[frame.robot, round(frame.timestamp_s, 6)] for frame in merged.version.keyframes]
    return seen[0], np.array(poses)


def firsts(runs: Any) -> list[int]:
    """Return the row of each run's first frame among all frames."""
    return [0, *np.cumsum([len(run.stamps_s) for run in runs]).tolist()][:-1]


def reference(graph: PoseGraph, interpreter: Path, rounds: int, cauchy: float) -> tuple[Array, float]:
    """Return the poses that g2o found, and its seconds."""
    order = {
        "g2o": write_g2o(graph), "robust": graph.robust.tolist(), "cauchy": cauchy, "rounds": rounds,
    }  # fmt: skip
    done = subprocess.run(
        [interpreter, REFERENCE], input=json.dumps(order), capture_output=True, text=True, check=True
    )
    answer = json.loads(done.stdout[done.stdout.index("{") :])
    return np.array(answer["poses"]), float(answer["seconds"])


def row(name: str, graph: PoseGraph, truth: Array, args: Options) -> dict[str, Any]:
    """Fit *graph* by both, with and without a kernel."""
    figures: dict[str, Any] = {"graph": name, "poses": len(graph.ids), "edges": len(graph.a)}
    for kernel in (0.0, CAUCHY):
        began = time.perf_counter()
        ours = optimise_graph(graph, OptimiseOptions(cauchy=kernel)).T_world_pose
        seconds = time.perf_counter() - began
        theirs, g2o_s = reference(graph, args.g2o_python, args.rounds, kernel)
        figures["kernel" if kernel else "squares"] = {
            "chi2": [graph.chi2(ours), graph.chi2(theirs)],
            "cost": [robust_cost(graph, poses, kernel) for poses in (ours, theirs)],
            "ate_cm": [100 * ate_m(poses, truth) for poses in (ours, theirs)],
            "seconds": [seconds, g2o_s],
        }
    both = figures["squares"]
    figures["chi2_over_g2o"] = both["chi2"][0] / both["chi2"][1]
    figures["ate_over_g2o"] = both["ate_cm"][0] / both["ate_cm"][1]
    figures["chi2_start"], figures["chi2_truth"] = graph.chi2(), graph.chi2(truth)
    figures["ate_start_cm"] = 100 * ate_m(graph.T_world_pose, truth)
    return figures


@benchmark(
    Bar("*.chi2_over_g2o", at_most=1.001),
    Bar("*.ate_over_g2o", at_most=1.1),
    Bar("*.squares.seconds.0", at_most=5.0, unit="s"),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Fit the graphs by both."""
    rows = [row("sphere", *make_sphere(7), args)]
    if args.recordings is not None:
        rows.append(row("red kitchen", *kitchen_graph(args.recordings), args))
    return {figures["graph"]: figures for figures in rows}
