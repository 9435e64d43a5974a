"""Measure ROS bags: is the map of a bag that of the folder, how fast is a large bag read, in how much memory.

Defends: the red kitchen written as ROS 1 bag, ROS 2 sqlite3 and ROS 2 MCAP, raw and compressed, gives the map
of the folder (ATE within 1 mm); 1 GB of raw images is read at 100 MB/s or more, in 300 MB of memory or less.
A bag is read twice, and both readings count: the rate is its size by their time together.  Poses are solved
in this process as the service does.  Each large bag is read in a process of its own, to measure its memory.

    python -m benchmarks maps.bags --recordings ../shared/data --out bags.json
    python -m benchmarks maps.bags --recordings ../shared/data --only-rate --kinds mcap
"""

from __future__ import annotations

import asyncio
import json
import resource
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark, command_of
from benchmarks.frame.report import say
from client_sdk.answers import PoseAnswer
from client_sdk.bags import BagKind, BagWriter, open_bag
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TF
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, PoseQuery
from client_sdk.mapper import Mapper
from client_sdk.mapping import read_trajectory
from rse_pf.experiments.results.trajectory_error import absolute_error
from rse_pf.geometry import Array, to_quaternion
from rse_pf.pnp import PnpOptions, refine_with_depth, solve_pnp

__all__ = ["answer_query", "write_recording"]

_RECORDING = "7scenes_redkitchen"
_KINDS: tuple[BagKind, ...] = ("ros1", "sqlite3", "mcap")
_START_S = 1_700_000_000
_LARGE_BYTES = 1_000_000_000


def write_recording(
    folder: Path,
    path: Path,
    kind: BagKind,
    *,
    is_raw: bool,
    frames: int | None = None,
    at_least_bytes: int = 0,
) -> None:
    """Write a recording in TUM layout as a bag with CameraInfo and tf.

    Args:
        folder: The recording.
        path: The new bag.
        kind: Its kind.
        is_raw: ``bgr8`` and ``16UC1``; else the JPEG files as they are, and compressedDepth.
        frames: Only so many.
        at_least_bytes: Play it again until so many bytes of images are written.
    """
    numbers = json.loads((folder / "intrinsics.json").read_text(encoding="utf-8"))
    lines = (folder / "rgb.txt").read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")][:frames]
    truth = read_trajectory(folder / "groundtruth.txt")
    written, loops, length_s = 0, 0, float(rows[-1][0]) + 0.1
    with BagWriter(path, kind) as w:
        while loops == 0 or written < at_least_bytes:
            for row, (stamp, name) in enumerate(rows):
                stamp_ns = round(1e9 * (float(stamp) + loops * length_s)) + _START_S * 1_000_000_000
                w.write("/tf", TF, stamp_ns, _transform(w, stamp_ns, truth.T_world_camera[row]))
                w.write("/camera/camera_info", CAMERA_INFO, stamp_ns, _camera_info(w, stamp_ns, numbers))
                written += _write_images(w, stamp_ns, folder, name, is_raw)
                if loops and written >= at_least_bytes:
                    break
            loops += 1


@benchmark(
    Bar("ate_off_folder_mm.*", at_most=1.0, unit="mm"),
    Bar("rates.*.mb_per_s", at_least=100, unit="MB/s"),
    Bar("rates.*.peak_mb", at_most=300, unit="MB"),
)
def run_benchmark(
    *, recordings: Recordings = Path("../shared/data"),
    kinds: Annotated[tuple[str, ...], "kinds of bags", _KINDS] = _KINDS,
    only_rate: Annotated[bool, "leave out the maps"] = False,
    only_maps: Annotated[bool, "leave out the large bags"] = False,
    folder: Annotated[Path | None, "where bags are written"] = None,
) -> dict[str, Any]:  # fmt: skip
    """Map and read bags of every kind."""
    maps, rates = [], []
    source = recordings / _RECORDING
    with tempfile.TemporaryDirectory(dir=folder) as made:
        if not only_rate:
            maps.append(_show(_map("folder", open_dataset(source), 0.0, source)))
        for kind in kinds:
            for is_raw in (True, False):
                name = f"{kind}, {'raw' if is_raw else 'compressed'}"
                path = Path(made) / (f"b-{is_raw}" + (".bag" if kind == "ros1" else ""))
                if not only_rate:
                    write_recording(source, path, kind, is_raw=is_raw)
                    with open_bag(path) as bag:
                        maps.append(_show(_map(name, bag, float(_START_S), source)))
                    _remove(path)
                if is_raw and not only_maps:
                    write_recording(source, path, kind, is_raw=True, at_least_bytes=_LARGE_BYTES)
                    done = subprocess.run(
                        command_of(print_reading, str(path)), check=True, capture_output=True, text=True
                    )
                    rates.append(_show({"bag": name, **json.loads(done.stdout)}))
                    _remove(path)
    off_mm = [abs(row["ate_mm"] - maps[0]["ate_mm"]) for row in maps[1:]]
    return {"maps": maps, "rates": rates, "ate_off_folder_mm": off_mm}


def print_reading(path: str) -> None:
    """Read a bag, in a process of its own, and print the figures."""
    print(json.dumps(_read(Path(path))))


def _read(path: Path) -> dict[str, Any]:
    files = [path] if path.is_file() else [entry for entry in path.rglob("*") if entry.is_file()]
    size = sum(file.stat().st_size for file in files)
    wall, cpu = time.perf_counter(), time.process_time()
    with open_bag(path) as bag:
        opened_s = time.perf_counter() - wall
        frames = sum(1 for _ in bag)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "bytes": size, "frames": frames, "opened_s": round(opened_s, 2), "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2), "mb_per_s": round(size / 1e6 / wall, 1),
        "mb_per_cpu_s": round(size / 1e6 / cpu, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
    }  # fmt: skip


def _map(name: str, frames: Iterable[Frame], start_s: float, source: Path) -> dict[str, Any]:
    """Track all frames, and return the error of the path and the size of the map."""
    mapper = Mapper(ask=answer_query)

    async def run() -> None:
        for frame in frames:
            await mapper.track(frame)

    asyncio.run(run())
    truth = read_trajectory(source / "groundtruth.txt")
    truth.timestamps_s[:] += start_s
    error = absolute_error(mapper.trajectory, truth)
    points, _ = mapper.map.points()
    return {
        "bag": name, "ate_mm": round(1e3 * error.rmse_m, 4), "poses": len(mapper.trajectory),
        "points": len(points), "mean_point_m": [round(float(value), 6) for value in points.mean(axis=0)],
    }  # fmt: skip


async def answer_query(query: PoseQuery) -> PoseAnswer:
    """Answer as the PnP service does."""
    matches = query.correspondences
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    solution = solve_pnp(matches.points_world, matches.pixels, query.camera, options)
    if matches.depths_m.any():
        solution = refine_with_depth(
            solution, matches.points_world, matches.pixels, matches.depths_m, query.camera
        )
    return PoseAnswer(
        solution=solution, source="cloud", server="s", round_trip_ms=1.0, queue_ms=0.0, compute_ms=1.0
    )


def _write_images(w: BagWriter, stamp_ns: int, folder: Path, name: str, is_raw: bool) -> int:
    header = w.header(stamp_ns, "camera_optical")
    depth = cv2.imread(str(folder / "depth" / f"{Path(name).stem}.png"), cv2.IMREAD_UNCHANGED)
    if is_raw:
        colour = cv2.imread(str(folder / name))
        for topic, image, encoding in (
            ("/camera/image_raw", colour, "bgr8"),
            ("/camera/aligned_depth", depth, "16UC1"),
        ):
            data = image.view(np.uint8).reshape(-1)
            message = w.make(
                IMAGE, header=header, height=image.shape[0], width=image.shape[1], encoding=encoding,
                is_bigendian=0, step=image.strides[0], data=data,
            )  # fmt: skip
            w.write(topic, IMAGE, stamp_ns, message)
        return int(colour.nbytes + depth.nbytes)
    jpeg = (folder / name).read_bytes()
    png = struct.pack("<iff", 0, 0.0, 0.0) + cv2.imencode(".png", depth)[1].tobytes()
    for topic, form, content in (
        ("/camera/image_raw/compressed", "bgr8; jpeg compressed bgr8", jpeg),
        ("/camera/aligned_depth/compressedDepth", "16UC1; compressedDepth png", png),
    ):
        pixels = np.frombuffer(content, dtype=np.uint8)
        message = w.make(COMPRESSED_IMAGE, header=header, format=form, data=pixels)
        w.write(topic, COMPRESSED_IMAGE, stamp_ns, message)
    return len(jpeg) + len(png)


def _camera_info(w: BagWriter, stamp_ns: int, numbers: dict[str, Any]) -> Any:
    fx, fy, cx, cy = (float(numbers[name]) for name in ("fx", "fy", "cx", "cy"))
    roi = w.make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return w.make(
        CAMERA_INFO, header=w.header(stamp_ns, "camera_optical"), height=int(numbers["height"]),
        width=int(numbers["width"]), distortion_model="plumb_bob",
        d=np.array(numbers["distortion"], dtype=float), k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
        r=np.eye(3).ravel(), p=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]), binning_x=0, binning_y=0,
        roi=roi,
    )  # fmt: skip


def _transform(w: BagWriter, stamp_ns: int, T: Array) -> Any:
    x, y, z = (float(value) for value in T[:3, 3])
    qx, qy, qz, qw = (float(value) for value in to_quaternion(T[:3, :3]))
    moved = w.make(
        "geometry_msgs/msg/Transform",
        translation=w.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=w.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
    header = w.header(stamp_ns, "world")
    one = w.make(
        "geometry_msgs/msg/TransformStamped", header=header, child_frame_id="camera_optical", transform=moved
    )
    return w.make(TF, transforms=[one])


def _show(row: dict[str, Any]) -> dict[str, Any]:
    say(row)
    return row


def _remove(path: Path) -> None:
    for entry in [path] if path.is_file() else [*path.iterdir(), path]:
        if entry.is_dir():
            entry.rmdir()
        else:
            entry.unlink()
