"""Measure a merge in parts: copies of the red kitchen on two worker processes, with and without kills.

Each copy of the map is moved as a whole, its poses drift, and its pixels, depths, descriptors and cloud have
noise.  The copies are merged three times: in one process, on worker processes, and on worker processes of
which one is killed, and then the scheduler as well.

Defends the promise that long jobs survive a crash of their server and that large merges run on several
processes.  The bars: with and without kills, loop closures and aligned clouds are equal to the bit to those
of one process, and poses differ by at most 0.1 mm; measuring loop closures and aligning clouds is at least
1.6 times as fast on two idle cores.

    python -m benchmarks cloud.batch --recordings ../shared/data --copies 20 --candidates 2 --out batch.json
    python -m benchmarks cloud.batch --recordings ../shared/data --copies 4 --frames 60

With 20 copies of 250 keyframes this takes an hour on two cores, with 4 copies of 60 about three minutes.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark, command_of
from benchmarks.frame.report import say
from rse_pf.config import PlatformSettings
from rse_pf.extensions.batch.dask_engine import DaskEngine, LocalCluster
from rse_pf.extensions.batch.merge import BatchMerge, BatchMergeResult
from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.maps.format import Edge, Keyframe, MapVersion, decode_map, encode_map
from rse_pf.processes.one_thread import ONE_THREAD
from rse_pf.slam.cloud_deform import deform_cloud
from rse_pf.slam.loop_closures import MergeOptions
from rse_pf.storage.object_store import DirectoryStore, digest_of
from tests.kit.in_process_engine import InProcessEngine

__all__ = ["kitchen", "noisy_copy"]

_DRIFT_M = 0.002  # standard deviation, metres per axis, of the drift of a copy between successive keyframes
_DRIFT_DEG = 0.05  # standard deviation, degrees per axis, of the drift of a copy between successive keyframes
_PIXEL_NOISE_PX = 0.3  # standard deviation of the pixels of features of a copy
_DEPTH_NOISE_M = 0.004  # standard deviation of the depths of features of a copy
_CLOUD_NOISE_M = 0.003  # standard deviation, per axis, of the points of the cloud of a copy
_FLIPPED_BITS = 0.02  # share of the bits of the descriptors of a copy that are flipped
# Steps of a merge that run on worker processes.
_PARALLEL = ("vectors", "pairs", "links", "agree", "tiles")


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments: *copies* maps are merged, with *candidates* as in `MergeOptions`."""

    recordings: Recordings = Path("../shared/data")
    copies: int = 4
    frames: Annotated[int, "of the recording; each is a keyframe"] = 250
    candidates: int = 6
    workers: int = 2
    folder: Annotated[Path | None, "where maps and parts are written (default: temporary)"] = None


def kitchen(recordings: Path, frames: int) -> MapVersion:
    """Return a map of the red kitchen: every frame is a keyframe at its tracked pose; with a cloud."""
    from benchmarks.recorded_drives import cloud_of, drive, keyframe_of, red_kitchen

    dataset = red_kitchen(recordings)
    run = drive(dataset, dataset.rows[:frames], "kitchen")
    keyframes = tuple(
        keyframe_of(dataset, row, T, number)
        for number, (row, T) in enumerate(zip(run.rows, run.T_world_camera, strict=True))
    )
    cloud, colours = cloud_of(dataset, run.rows[::10], run.T_world_camera[::10], 0.02).points()
    return MapVersion(
        keyframes=keyframes, points=cloud.astype(np.float32), colours=colours.astype(np.uint8)
    )  # fmt: skip


def noisy_copy(version: MapVersion, number: int) -> MapVersion:
    """Return *version* as another robot would have mapped it, with drift and noise; *number* is the seed."""
    rng = np.random.default_rng(number)
    start = np.eye(4) if number == 0 else exp_se3(rng.normal(size=6) * np.array([2, 2, 0.2, 0.1, 0.1, 1.0]))
    spread = np.array([_DRIFT_M] * 3 + [np.radians(_DRIFT_DEG)] * 3)
    old = [keyframe.T_world_camera for keyframe in version.keyframes]
    poses, edges = [start @ old[0]], []
    for row in range(1, len(old)):
        step = inverse(old[row - 1]) @ old[row] @ exp_se3(rng.normal(size=6) * spread)
        poses.append(poses[-1] @ step)
        edges.append(Edge(a=row - 1, b=row, T_a_b=step, information=np.diag(spread**-2.0)))
    keyframes = tuple(
        _noisy(keyframe, T, number, rng) for keyframe, T in zip(version.keyframes, poses, strict=True)
    )
    points = deform_cloud(version.points, version.keyframes, np.array(poses))
    points += rng.normal(size=points.shape) * _CLOUD_NOISE_M
    return MapVersion(
        keyframes=keyframes, edges=tuple(edges), points=points.astype(np.float32), colours=version.colours
    )  # fmt: skip


@benchmark(
    Bar("links_and_clouds_equal", equals=True),
    Bar("apart_mm", at_most=0.1, unit="mm"),
    Bar("not_joined", equals=0),
    Bar("speed_up_links_and_icp", at_least=1.6, unit="times"),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Merge in one process, on worker processes, and on worker processes that are killed."""
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        return _measure(args, Path(folder))


def _measure(args: Options, folder: Path) -> dict[str, Any]:
    source = kitchen(args.recordings, args.frames)
    names = []
    store = DirectoryStore(folder / "one")
    for number in range(args.copies):
        data = encode_map(noisy_copy(source, number))
        names.append(f"maps/{digest_of(data)}")
        store.put(names[-1], data)
    (folder / "names.json").write_text(json.dumps(names), encoding="utf-8")
    say(f"{args.copies} maps of {len(source.keyframes)} keyframes and {len(source.points)} points")
    report: dict[str, Any] = {
        "copies": args.copies, "keyframes": args.copies * len(source.keyframes),
        "points": args.copies * len(source.points), "candidates": args.candidates,
    }  # fmt: skip
    subprocess.run(
        command_of(merge_in_one_process, str(folder), str(args.candidates)), env=_environment(), check=True
    )
    one = json.loads((folder / "one.json").read_text(encoding="utf-8"))
    say(f"one process: {one['seconds']:.0f} s")
    two, quiet = _in_workers(args, folder, names, "two", kills=False)
    say(f"{args.workers} workers: {quiet['seconds']:.0f} s")
    killed, broken = _in_workers(args, folder, names, "killed", kills=True)
    say(f"with kills: {broken['seconds']:.0f} s, {broken['events']}")
    report |= {"one_process": one, "workers": quiet, "workers_killed": broken}
    speed_up = _seconds_of(one, *_PARALLEL) / _seconds_of(quiet, *_PARALLEL)
    apart_m = _apart_m(killed.merged.version, _merge(folder, "one"))
    report |= {
        "links": len(two.links), "clouds_aligned": len(two.tiles),
        "speed_up_links_and_icp": round(speed_up, 3),
        "speed_up_whole": round(one["seconds"] / quiet["seconds"], 3),
        "apart_mm": round(1e3 * apart_m, 6),
        "links_and_clouds_equal": one["digest"] == quiet["digest"] == broken["digest"],
        "not_joined": args.copies - len(killed.merged.joined),
    }  # fmt: skip
    return report


def merge_in_one_process(folder_name: str, candidates: str) -> None:
    """Merge the maps of a folder in this process; write the merged maps and their figures there."""
    folder = Path(folder_name)
    store = DirectoryStore(folder / "one")
    names = json.loads((folder / "names.json").read_text(encoding="utf-8"))
    options = MergeOptions(candidates=int(candidates))
    began = time.monotonic()
    result = BatchMerge(store, InProcessEngine(store), PlatformSettings(), options=options).run(names)
    seconds = time.monotonic() - began
    (folder / "one.map").write_bytes(encode_map(result.merged.version))
    (folder / "one.json").write_text(json.dumps(_figures(result, seconds)), encoding="utf-8")


def _in_workers(
    args: Options, folder: Path, names: list[str], called: str, *, kills: bool
) -> tuple[BatchMergeResult, dict[str, Any]]:
    """Merge on worker processes; if *kills*, kill a worker after a third and the scheduler after two thirds.

    The shares are of the step that measures loop closures.
    """
    store, source = DirectoryStore(folder / called), DirectoryStore(folder / "one")
    for name in names:
        store.put(name, source.get(name))
    settings = PlatformSettings().replace(data={"store": f"dir:{folder / called}"})
    cluster = LocalCluster(args.workers)
    events: list[str] = []
    engine = DaskEngine(store, settings, cluster, on_event=events.append)
    kill = _killer(cluster) if kills else lambda done, what: None
    began = time.monotonic()
    try:
        engine.start()
        up_s = time.monotonic() - began
        options = MergeOptions(candidates=args.candidates)
        result = BatchMerge(store, engine, settings, options=options).run(names, kill)
    finally:
        engine.close()
        cluster.stop()
    return result, {**_figures(result, time.monotonic() - began), "up_s": round(up_s, 2), "events": events}


def _killer(cluster: LocalCluster) -> Callable[[float, str], None]:
    killed: list[int] = []

    def report(done: float, what: str) -> None:
        if "parts of links" not in what:
            return
        share = int(what.split()[0]) / int(what.split()[2])
        if share >= 1 / 3 and not killed:
            killed.append(cluster.worker_pids[0])
            os.kill(killed[-1], signal.SIGKILL)
        elif share >= 2 / 3 and len(killed) == 1:
            killed.append(cluster.scheduler_pid)
            os.kill(killed[-1], signal.SIGKILL)

    return report


def _environment() -> dict[str, str]:
    return {**os.environ, **ONE_THREAD}


def _figures(result: BatchMergeResult, seconds: float) -> dict[str, Any]:
    parts = b"".join(
        link.T_a_b.tobytes() + link.information.tobytes() + bytes(f"{link.a} {link.b};", "ascii")
        for link in (*result.links, *result.tiles)
    )
    return {
        "seconds": round(seconds, 2), "by_step_s": {k: round(v, 2) for k, v in result.seconds.items()},
        "parts": result.computed, "digest": digest_of(parts),
    }  # fmt: skip


def _seconds_of(figures: dict[str, Any], *steps: str) -> float:
    return float(sum(figures["by_step_s"].get(step, 0.0) for step in steps))


def _merge(folder: Path, name: str) -> MapVersion:
    return decode_map((folder / f"{name}.map").read_bytes())


def _apart_m(one: MapVersion, other: MapVersion) -> float:
    """Return the largest distance, metres, between the positions of one keyframe in both maps."""

    def places(version: MapVersion) -> Array:
        return np.array([keyframe.T_world_camera[:3, 3] for keyframe in version.keyframes])

    return float(np.linalg.norm(places(one) - places(other), axis=1).max())


def _noisy(keyframe: Keyframe, T_world_camera: Array, number: int, rng: np.random.Generator) -> Keyframe:
    count = len(keyframe.pixels)
    points = keyframe.points_camera.astype(np.float64)
    points *= 1.0 + (rng.normal(size=(count, 1)) * _DEPTH_NOISE_M) / np.maximum(points[:, 2:], 0.3)
    flips = np.packbits(rng.random((count, 256)) < _FLIPPED_BITS, axis=1)
    return Keyframe(
        id=keyframe.id, robot=f"copy-{number}", timestamp_s=keyframe.timestamp_s,
        T_world_camera=T_world_camera, camera=keyframe.camera,
        pixels=(keyframe.pixels + rng.normal(size=(count, 2)) * _PIXEL_NOISE_PX).astype(np.float32),
        descriptors=keyframe.descriptors ^ flips, points_camera=points.astype(np.float32),
    )  # fmt: skip
