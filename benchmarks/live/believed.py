"""How close honest robots of the recordings come to being disbelieved, with and without slipping wheels.

Three robots drive through parts of the red kitchen, and four through unrelated recordings; the steps of their
odometry are scaled by the slip.

    python -m benchmarks live.believed --recordings ../shared/data --runs 3
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.frame.registry import Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.live.one_process import DENSE, FOREIGN, KITCHEN_CUTS, play
from benchmarks.maps.recordings import Run, drive, red_kitchen
from client_sdk.datasets import open_dataset
from client_sdk.frontend import FrontEndOptions
from rse_pf.geometry import inverse
from rse_pf.live_map.live_map import LiveMap

__all__ = ["most_contradictions", "slipping"]


def slipping(run: Run, slip: float) -> Run:
    """Return *run* with each step of its odometry between keyframes *slip* times as long."""
    keyframes = list(run.version.keyframes)
    T = [keyframes[0].T_world_camera]
    for one, other in pairwise(keyframes):
        step = inverse(one.T_world_camera) @ other.T_world_camera
        step[:3, 3] *= slip
        T.append(T[-1] @ step)
    moved = tuple(
        dataclasses.replace(keyframe, T_world_camera=pose)
        for keyframe, pose in zip(keyframes, T, strict=True)
    )
    return dataclasses.replace(run, version=dataclasses.replace(run.version, keyframes=moved))


def most_contradictions(live_map: LiveMap) -> tuple[int, int, int]:
    """Return the most contradicting keyframes of 32, disbelieved segments, and the most smoothing used."""
    segments = live_map._graph.segments
    return (
        max(segment.contradictions.bit_count() for segment in segments),
        sum(segment.disbelieved for segment in segments),
        max(live_map._graph.smoothing.values(), default=0),
    )


@benchmark()
def run_benchmark(*, recordings: Recordings = Path("../shared/data"), runs: int = 3) -> dict[str, Any]:
    """Play both sets of robots with every slip."""
    kitchen = red_kitchen(recordings)
    sets = {"kitchen": {name: drive(kitchen, rows, name, DENSE) for name, rows in KITCHEN_CUTS.items()}}
    sets["foreign"] = {}
    for name in FOREIGN:
        dataset = open_dataset(recordings / name)
        options = FrontEndOptions.wide_baseline() if name.startswith("nyu") else DENSE
        sets["foreign"][name] = drive(dataset, range(min(len(dataset), 84)), name, options)
    rows = []
    for what, drives in sets.items():
        for slip in (1.0, 0.9, 1.1):
            slipped = {name: slipping(run, slip) for name, run in drives.items()}
            most = disbelieved = smoothed = 0
            for seed in range(runs):
                at = np.random.default_rng(seed).integers(0, 60, len(drives))
                starts = dict(zip(drives, (at - at.min()).tolist(), strict=True))
                contradictions = most_contradictions(play(slipped, starts).live_map)
                most, disbelieved = max(most, contradictions[0]), disbelieved + contradictions[1]
                smoothed = max(smoothed, contradictions[2])
            rows.append(
                {
                    "robots": what, "slip": slip, "n": runs, "contradicting_of_32_keyframes": most,
                    "segments_disbelieved": disbelieved, "used_of_2000_of_the_budget": smoothed,
                }
            )  # fmt: skip
            say(rows[-1])
    return {"rows": rows}
