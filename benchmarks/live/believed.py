"""How close honest robots of the recordings come to being disbelieved, with and without slipping wheels.

Three robots drive through parts of the red kitchen, and four through unrelated recordings; the steps of their
odometry are scaled by the slip.

    python -m benchmarks.live.believed --recordings ../shared/data --runs 3
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.live.one_process import DENSE, FOREIGN, KITCHEN_CUTS, play
from benchmarks.maps.recordings import Run, drive, red_kitchen
from client_sdk.datasets import open_dataset
from client_sdk.frontend import FrontEndOptions
from rse_pf.geometry import inverse
from rse_pf.live_map.live_map import LiveMap

__all__ = ["main", "most_contradictions", "slipping"]


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what the module's docstring says."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.live.believed")
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--runs", type=int, default=3)
    chosen = parser.parse_args(arguments)
    kitchen = red_kitchen(chosen.recordings)
    sets = {"kitchen": {name: drive(kitchen, rows, name, DENSE) for name, rows in KITCHEN_CUTS.items()}}
    sets["foreign"] = {}
    for name in FOREIGN:
        dataset = open_dataset(chosen.recordings / name)
        options = FrontEndOptions.wide_baseline() if name.startswith("nyu") else DENSE
        sets["foreign"][name] = drive(dataset, range(min(len(dataset), 84)), name, options)
    for what, runs in sets.items():
        for slip in (1.0, 0.9, 1.1):
            slipped = {name: slipping(run, slip) for name, run in runs.items()}
            most = disbelieved = smoothed = 0
            for seed in range(chosen.runs):
                at = np.random.default_rng(seed).integers(0, 60, len(runs))
                starts = dict(zip(runs, (at - at.min()).tolist(), strict=True))
                contradictions = most_contradictions(play(slipped, starts).live_map)
                most, disbelieved = max(most, contradictions[0]), disbelieved + contradictions[1]
                smoothed = max(smoothed, contradictions[2])
            print(
                f"{what}, steps x{slip:g}, {chosen.runs} runs: at most {most} of 32 keyframes contradict, "
                f"{disbelieved} segments disbelieved, {smoothed} of 2,000 of the budget used at the end; "
                f"load {os.getloadavg()[0]:.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
