"""Recordings of EuRoC (ASL) and KITTI odometry as frames of their left camera, without depth.

Frames are undistorted; the truth is that of the camera.  The right camera and the IMU are not read here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from client_sdk.datasets.intrinsics import Intrinsics, Undistortion
from client_sdk.datasets.recordings import Dataset, read_colour
from client_sdk.frontend import Frame
from client_sdk.mapping import Trajectory
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import Array, Camera, from_quaternion

__all__ = ["is_euroc", "is_kitti", "open_euroc", "open_kitti", "read_euroc_camera"]

_MAX_BYTES = 64 << 20
_EUROC_TRUTH = "state_groundtruth_estimate0/data.csv"


def is_euroc(folder: Path) -> bool:
    """Return whether a folder, or its ``mav0``, has the layout of EuRoC."""
    return (_asl(folder) / "cam0" / "sensor.yaml").is_file()


def is_kitti(folder: Path) -> bool:
    """Return whether a folder has the layout of a sequence of KITTI's odometry benchmark."""
    return (folder / "image_0").is_dir() and (folder / "calib.txt").is_file()


def open_euroc(folder: Path) -> Dataset:
    """Return the frames of ``cam0``; time stamps are seconds, the truth is ``T_world_body @ T_BS``.

    Raises:
        UsageError: A file is missing or broken.
    """
    folder = _asl(folder)
    lens, T_body_camera = read_euroc_camera(folder / "cam0" / "sensor.yaml")
    rows = _csv(folder / "cam0" / "data.csv", 2)
    stamps_s = _numbers(folder / "cam0" / "data.csv", [row[0] for row in rows]) / 1e9
    paths = [folder / "cam0" / "data" / row[1].strip() for row in rows]
    truth = None
    if (folder / _EUROC_TRUTH).is_file():
        lines = [row[:8] for row in _csv(folder / _EUROC_TRUTH, 8)]
        values = _numbers(folder / _EUROC_TRUTH, [word for row in lines for word in row]).reshape(-1, 8)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, 3] = values[:, 1:4]
        poses[:, :3, :3] = [from_quaternion(xyzw) for xyzw in values[:, [5, 6, 7, 4]]]
        truth = Trajectory(values[:, 0] / 1e9, poses @ T_body_camera)
    name = folder.parent.name if folder.name == "mav0" else folder.name
    return _dataset(name or folder.name, paths, stamps_s, lens, truth, T_body_camera)


def read_euroc_camera(path: Path) -> tuple[Intrinsics, Array]:
    """Return the lens of a ``sensor.yaml`` and the ``(4, 4)`` ``T_BS``, the pose of the camera in the body.

    Raises:
        UsageError: A number is missing or impossible.
    """
    text = _text(path)
    found = {
        name: _list_after(text, rf"^{name}:", path)
        for name in ("resolution", "intrinsics", "distortion_coefficients")
    }
    pose = _list_after(text, r"^\s*data:", path)
    if [len(found["resolution"]), len(found["intrinsics"]), len(pose)] != [2, 4, 16]:
        raise UsageError(f"{path} is not that of a camera", hint="unpack the recording again")
    (fx, fy, cx, cy), (width, height) = found["intrinsics"], found["resolution"]
    try:
        camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height))
        lens = Intrinsics(camera=camera, distortion=tuple(found["distortion_coefficients"]))
    except (InvalidCamera, UsageError) as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error
    return lens, np.array(pose).reshape(4, 4)


def open_kitti(folder: Path) -> Dataset:
    """Return the frames of ``image_0``; the truth is in ``poses.txt``, or in ``../../poses/NAME.txt``.

    Raises:
        UsageError: A file is missing or broken.
    """
    first_line = _text(folder / "calib.txt").partition("\n")[0]
    numbers = _list(folder / "calib.txt", first_line.partition(":")[2])
    stamps_s = _numbers(folder / "times.txt", _text(folder / "times.txt").split())
    paths = sorted(path for path in (folder / "image_0").iterdir() if path.suffix in (".png", ".jpg"))
    if len(numbers) != 12 or not paths or not len(stamps_s):
        raise UsageError(
            f"{folder} lacks images, times or the 12 numbers of P0", hint="unpack the sequence again"
        )
    paths, stamps_s = paths[: len(stamps_s)], stamps_s[: len(paths)]
    height, width = read_colour(paths[0]).shape[:2]
    camera = Camera(
        fx=numbers[0], fy=numbers[5], cx=numbers[2], cy=numbers[6], width=width, height=height
    )  # fmt: skip
    truth = None
    known = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    path = next((each for each in known if each.is_file()), None)
    if path is not None:
        values = _numbers(path, _text(path).split())
        if len(values) % 12 or len(values) < 12 * len(paths):
            raise UsageError(f"{path} has not 12 numbers for each image", hint="unpack the sequence again")
        poses = np.tile(np.eye(4), (len(paths), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)[: len(paths)]
        truth = Trajectory(stamps_s, poses)
    return _dataset(folder.name, paths, stamps_s, Intrinsics(camera=camera), truth, None)


def _dataset(
    name: str,
    paths: Sequence[Path],
    stamps_s: Array,
    lens: Intrinsics,
    truth: Trajectory | None,
    T_body_camera: Array | None,
) -> Dataset:
    camera, undistort = lens.camera, Undistortion(lens)
    if not len(paths) or bool((np.diff(stamps_s) <= 0).any()):
        raise UsageError(
            f"{name} has no images, or their times do not ascend", hint="unpack the recording again"
        )
    no_depth: npt.NDArray[np.float32] = np.zeros((camera.height, camera.width), dtype=np.float32)

    def read(row: int) -> Frame:
        rgb = undistort.colour(read_colour(paths[row]))
        return Frame(timestamp_s=float(stamps_s[row]), rgb=rgb, depth_m=no_depth, camera=camera)

    return Dataset(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamps_s.tolist()),
        truth=truth,
        truth_kind="none" if truth is None else "ground truth",
        rows=tuple(range(len(paths))),
        read=read,
        has_depth=False,
        T_body_camera=T_body_camera,
    )


def _asl(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _text(path: Path) -> str:
    try:
        return read_regular_file(path, _MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}", hint="unpack the recording again") from error


def _csv(path: Path, columns: int) -> list[list[str]]:
    """Return the rows of a table of EuRoC; a line that begins with ``#`` is a heading."""
    lines = [line for line in _text(path).splitlines() if line.strip() and not line.startswith("#")]
    rows = [line.split(",") for line in lines]
    if any(len(row) < columns for row in rows):
        raise UsageError(f"{path} has a row of less than {columns} values", hint="unpack it again")
    return rows


def _list_after(text: str, heading: str, path: Path) -> list[float]:
    found = re.search(rf"{heading}\s*\[([^\]]*)\]", text, re.MULTILINE)
    return [] if found is None else _list(path, found[1])


def _list(path: Path, text: str) -> list[float]:
    numbers: list[float] = _numbers(path, text.replace(",", " ").split()).tolist()
    return numbers


def _numbers(path: Path, words: Sequence[str]) -> Array:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise UsageError(f"{path} holds a word that is no number", hint="unpack it again") from error
    if not np.isfinite(values).all():
        raise UsageError(f"{path} holds a number that is not finite", hint="unpack it again")
    return values
