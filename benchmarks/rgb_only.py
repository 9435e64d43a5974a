"""Measure maps of a camera without depth: trajectory error with and without a scale, lost frames, time.

Defends: red kitchen at 10 Hz without its depth, scale by the first metre of odometry (the true poses of that
metre stand for odometry): ATE <= 8 cm, lost frames <= 5 %; without a scale the error after a similarity
alignment (Sim(3)) is reported.  Poses are solved in this process as the service does.  CPU figures are of all
threads of the process; the load average stands beside them.

    python benchmarks/rgb_only.py --recordings ../shared/data --out rgb_only.json
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.answers import PoseAnswer
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import PoseQuery
from client_sdk.mapper import Mapper
from client_sdk.mapping import Trajectory
from client_sdk.monocular.scale import OdometryScale
from rse_pf.experiments.results.trajectory_error import absolute_error
from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.services.pnp import make_request
from rse_pf.wire import Command, make_codec

__all__ = ["main"]

_RECORDING = "7scenes_redkitchen"
_MAX_ATE_CM, _MAX_LOST_PERCENT = 8.0, 5.0


def row_of(dataset: Dataset, *, with_scale: bool) -> dict[str, Any]:
    """Map a recording without its depth; return errors, lost frames, time and the size of commands."""
    truth = dataset.truth
    assert truth is not None
    codecs = {name: make_codec(name) for name in ("json", "zlib", "bin")}
    sizes: dict[str, list[int]] = {name: [] for name in codecs}

    async def ask(query: PoseQuery) -> PoseAnswer:
        found = query.correspondences
        options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
        for name, codec in codecs.items():
            request = make_request(
                found.points_world, found.pixels, query.camera, options, binary=name == "bin"
            )
            sizes[name].append(len(codec.encode(Command(id=1, service="pnp", payload=request))))
        solution = solve_pnp(found.points_world, found.pixels, query.camera, options)
        return PoseAnswer(
            solution=solution, source="robot", server="", round_trip_ms=0.0, queue_ms=0.0, compute_ms=0.0
        )

    scale = OdometryScale(truth.timestamps_s, truth.positions) if with_scale else None
    mapper = Mapper(ask=ask, depth=False, scale=scale)
    live: list[tuple[float, Any]] = []
    frame_ms: list[float] = []

    async def drive() -> None:
        for frame in dataset:
            frame = replace(frame, depth_m=np.zeros_like(frame.depth_m))
            began = time.process_time()
            done = await mapper.track(frame)
            frame_ms.append(1e3 * (time.process_time() - began))
            if done.T_world_camera is not None and done.scale == ("metric" if with_scale else "up to scale"):
                live.append((frame.timestamp_s, done.T_world_camera))

    asyncio.run(drive())
    adjusted = mapper.trajectory
    as_it_came = Trajectory(np.array([stamp for stamp, _ in live]), np.array([pose for _, pose in live]))
    return {
        "frames": len(dataset),
        "poses": len(adjusted),
        "lost": mapper.lost_frames,
        "keyframes": mapper.keyframes,
        "landmarks": mapper.report()["map_points"],
        "scale": mapper.scale,
        "ate_cm": 100 * absolute_error(adjusted, truth).rmse_m if with_scale else None,
        "live_ate_cm": 100 * absolute_error(as_it_came, truth).rmse_m if with_scale else None,
        "sim3_cm": 100 * absolute_error(adjusted, truth, with_scale=True).rmse_m,
        "sim3_scale": absolute_error(adjusted, truth, with_scale=True).scale,
        "path_m": truth.length_m,
        "cpu_ms_p50_p95_max": [float(np.percentile(frame_ms, q)) for q in (50, 95, 100)],
        "command_bytes_max": {name: max(each) for name, each in sizes.items()},
        "load_average": os.getloadavg()[0],
    }


def main() -> int:
    """Print the rows, and return 1 if a bar is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    parser.add_argument("--rates", type=float, nargs="+", default=[10.0], metavar="HZ")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}, n = 1")
    rows: dict[str, Any] = {}
    for rate_hz in args.rates:
        dataset = open_dataset(args.recordings / _RECORDING).thinned(rate_hz)
        for with_scale in (True, False):
            row = row_of(dataset, with_scale=with_scale)
            rows[f"{rate_hz:g} Hz, {'first metre of odometry' if with_scale else 'no scale'}"] = row
            ate = "-" if row["ate_cm"] is None else f"{row['ate_cm']:.2f} cm"
            print(
                f"{rate_hz:g} Hz; {row['scale']}: ATE {ate}, Sim(3) {row['sim3_cm']:.2f} cm at scale "
                f"{row['sim3_scale']:.3f}; {row['lost']} of {row['frames']} lost, {row['poses']} poses, "
                f"{row['keyframes']} keyframes, {row['landmarks']} points; CPU of a frame p50 / p95 / max "
                + " / ".join(f"{each:.0f}" for each in row["cpu_ms_p50_p95_max"])
                + f" ms; largest command {row['command_bytes_max']} bytes; load {row['load_average']:.1f}",
                flush=True,
            )
    if args.out:
        args.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    first = rows[f"{args.rates[0]:g} Hz, first metre of odometry"]
    good = first["ate_cm"] <= _MAX_ATE_CM and first["lost"] <= _MAX_LOST_PERCENT / 100 * first["frames"]
    print(f"bar ATE <= {_MAX_ATE_CM:g} cm, lost <= {_MAX_LOST_PERCENT:g} %: {'met' if good else 'MISSED'}")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
