"""Calibrate cameras without a board, and track one lens with the found intrinsics and with the true ones.

    python -m benchmarks maps.calibration ../shared/data [--only "KITTI 00" "phone"]

Recordings: the red kitchen, MH_01 (left camera), KITTI 06 and 00.  Rendered rooms are seen through four
lenses with distortion: those of a phone, a webcam, a wide and a telephoto camera.  A row has the true and the
found focal length, the error in percent and in standard deviations, and the ATE (Sim(3)) of all poses: the
median of three drives that begin 5 frames apart, because one lens drifts by chance.  If a calibration is
refused, the row has the reason only.  Focal lengths of two runs over the same images differed by up to 0.2 %.

Defends the promise that maps are made from one lens without a calibration board: the ATE with an estimated
calibration is at most 1.3 times the ATE with the true one, and no focal length is wrong by more than three of
the standard deviations that the calibration states.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.recorded_drives import RED_KITCHEN, track
from client_sdk.cameras.folder import list_folder
from client_sdk.cameras.self_calibration import calibrate_from_motion
from client_sdk.cameras.source import RawFrame, undistorted
from client_sdk.cameras.view_selection import select_views
from client_sdk.datasets import open_dataset, read_colour
from client_sdk.rigs.benchmark_files import read_euroc_camera
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.simulator import make_world, true_trajectory
from client_sdk.simulator.renderer import Renderer, add_image_noise
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.errors import CommandFailed
from rse_pf.geometry import Camera
from rse_pf.images import load_opencv

WIDTH = 640  # width of the rendered images, px
HEIGHT = 480  # height of the rendered images, px
RENDERED_FRAMES = 150  # number of frames rendered for each lens: 10 m of path
TRACKED_FRAMES = 120  # most frames of a drive that is tracked
FIRST_FRAMES = (0, 5, 10)  # first frames of the tracked drives
LENSES = {
    "phone": (520.0, 325.0, 236.0, 0.10, -0.20),
    "webcam": (610.0, 314.0, 243.0, -0.10, 0.05),
    "wide": (340.0, 322.0, 238.0, -0.25, 0.06),
    "telephoto": (900.0, 317.0, 241.0, 0.02, 0.0),
}
"""Focal length and principal point in px, k1 and k2 of each rendered lens."""
IMAGES = {
    "kitchen": (RED_KITCHEN, "rgb"), "MH_01": ("euroc_mh01_start", "mav0/cam0/data"),
    "KITTI 06": ("kitti_06_start", "image_0"), "KITTI 00": ("kitti_00_left_start", "image_0"),
}  # fmt: skip
"""Folder of each recording, and the folder of its images in it."""
# Names of all recordings and rendered lenses.
CASES = (*IMAGES, *LENSES)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A drive: its true intrinsics and path, and a function that returns the images with lens distortion."""

    lens: Intrinsics
    truth: Trajectory
    read: Callable[[], Iterator[RawFrame]]


@benchmark(
    Bar("*.ate_ratio", at_most=1.3),
    Bar("*.focal_error_sigmas", at_most=3.0),
)
def run_benchmark(
    *, data: Recordings, only: Annotated[tuple[str, ...], "cases to measure", CASES] = CASES
) -> dict[str, Any]:
    """Calibrate and track each case."""
    figures: dict[str, Any] = {}
    for name in only:
        drive = recorded_drive(data, name) if name in IMAGES else rendered_drive(name)
        figures[name] = row_of(drive)
        say(f"{name}: {figures[name]}")
    return figures


def row_of(drive: Drive) -> dict[str, Any]:
    """Calibrate by the images of a drive, and compare the estimated intrinsics with the true ones."""
    began_s = time.monotonic()
    cv2 = load_opencv()
    views, _ = select_views(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for _, rgb, _ in drive.read())
    try:
        found = calibrate_from_motion(views)
    except CommandFailed as error:
        return {"refused": error.message}
    took_s = time.monotonic() - began_s
    camera, true_camera = found.intrinsics.camera, drive.lens.camera
    true_px, found_px = (true_camera.fx + true_camera.fy) / 2, camera.fx
    sigma_px = found.standard_deviations["f"]
    true_m, found_m = (ate_m(drive, lens) for lens in (drive.lens, found.intrinsics))
    return {
        "true_px": round(true_px, 1),
        "found_px": round(found_px, 1),
        "sigma_px": round(sigma_px, 2),
        "focal_error_percent": round(100.0 * (found_px / true_px - 1.0), 2),
        "focal_error_sigmas": round(abs(found_px - true_px) / sigma_px, 1),
        "centre_error_px": round(float(np.hypot(camera.cx - true_camera.cx, camera.cy - true_camera.cy)), 1),
        "ate_true_cm": round(100.0 * true_m, 2),
        "ate_found_cm": round(100.0 * found_m, 2),
        "ate_ratio": round(found_m / true_m, 2),
        "seconds": round(took_s, 1),
    }


def ate_m(drive: Drive, lens: Intrinsics) -> float:
    """Return the median ATE of drives with the intrinsics *lens*, metres; infinite without a path."""
    errors_m = []
    for first in FIRST_FRAMES:
        tracker = MonocularTracker()
        images = itertools.islice(drive.read(), first, first + TRACKED_FRAMES)
        for frame in undistorted(images, lens, "drive"):
            track(tracker, frame)
        path = tracker.trajectory()
        errors_m.append(accuracy(path, drive.truth, with_scale=True).ate_m if len(path) >= 3 else np.inf)
    return float(np.median(errors_m))


def recorded_drive(data: Path, name: str) -> Drive:
    """Return a recording as the images in its folder, with the intrinsics that it states."""
    folder, images = IMAGES[name]
    dataset = open_dataset(data / folder, camera="left", imu=False)
    paths = list_folder(data / folder / images).images
    assert dataset.truth is not None
    is_euroc = images.startswith("mav0")
    sensor = data / folder / "mav0" / "cam0" / "sensor.yaml"
    lens = read_euroc_camera(sensor, "left").lens if is_euroc else Intrinsics(camera=dataset.camera)

    def read() -> Iterator[RawFrame]:
        for stamp_s, path in zip(dataset.timestamps_s, paths, strict=True):
            yield stamp_s, read_colour(path), None

    return Drive(lens=lens, truth=dataset.truth, read=read)


def rendered_drive(name: str) -> Drive:
    """Return a drive through rendered rooms that is seen through the lens *name*."""
    cv2 = load_opencv()
    seed = list(LENSES).index(name)
    f, cx, cy, *distortion = LENSES[name]
    lens = Intrinsics(
        camera=Camera(fx=f, fy=f, cx=cx, cy=cy, width=WIDTH, height=HEIGHT),
        distortion=(*distortion, 0.0, 0.0),
    )
    # 1. Find the ray of each pixel, and a pinhole camera without distortion that sees all these rays.
    columns, rows = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, lens.camera.matrix, np.array(lens.distortion)).reshape(
        HEIGHT, WIDTH, 2
    )
    half_width, half_height = (int(np.ceil(f * side)) + 1 for side in np.abs(rays).max(axis=(0, 1)))
    pinhole = Camera(
        fx=f, fy=f, cx=half_width, cy=half_height, width=2 * half_width + 1, height=2 * half_height + 1
    )
    places = (f * rays + [half_width, half_height]).astype(np.float32)
    # 2. Draw what this pinhole camera sees, and look up each pixel there.
    truth = true_trajectory(seed, len(LENSES), RENDERED_FRAMES, seed)
    renderer = Renderer(make_world(seed), pinhole)

    images: list[RawFrame] = []
    for row, stamp_s in enumerate(truth.timestamps_s):
        seen = renderer.draw(truth.T_world_camera[row])[0]
        colour = cv2.remap(seen.astype(np.float32), places, None, cv2.INTER_LINEAR)
        images.append((float(stamp_s), add_image_noise(colour, np.random.default_rng([seed, row])), None))
    return Drive(lens=lens, truth=truth, read=lambda: iter(images))
