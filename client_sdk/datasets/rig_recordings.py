"""Recordings of EuRoC (ASL) and KITTI odometry as frames of their left camera or of the stereo pair.

Frames of one camera are undistorted, those of a pair rectified; the truth is that of the frames' camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags.index import pair_stamps
from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import read_colour
from client_sdk.frontend import Frame, load_opencv
from client_sdk.mapping import Trajectory
from client_sdk.rigs.benchmark_files import (
    read_euroc_camera,
    read_euroc_imu,
    read_kitti_rig,
    read_numbers,
    read_text,
)
from client_sdk.rigs.imu_track import ImuTrack
from client_sdk.rigs.intrinsics import Undistortion
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, from_quaternion

__all__ = ["CameraChoice", "is_euroc", "is_kitti", "open_euroc", "open_kitti"]

CameraChoice = Literal["stereo", "left"]

_EUROC_TRUTH = "state_groundtruth_estimate0/data.csv"
_MAX_PAIR_S = 0.005
"""The shutters of a pair open together; stamps that are farther apart are those of other images."""


def is_euroc(folder: Path) -> bool:
    """Return whether a folder, or its ``mav0``, has the layout of EuRoC."""
    return (_asl(folder) / "cam0" / "sensor.yaml").is_file()


def is_kitti(folder: Path) -> bool:
    """Return whether a folder has the layout of a sequence of KITTI's odometry benchmark."""
    return (folder / "image_0").is_dir() and (folder / "calib.txt").is_file()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Files:
    """Images of the left camera, and of the right one where it is used, with their ``(n,)`` times."""

    lefts: Sequence[Path]
    rights: Sequence[Path] | None
    stamps_s: Array
    notes: tuple[str, ...] = ()


def open_euroc(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the frames of ``cam0``, or of both cameras, with the samples of ``imu0``.

    Time stamps are seconds; the truth is ``T_world_body @ T_body_camera``.

    Args:
        folder: With ``mav0``, or that itself.
        camera: None takes both cameras where there are two.
        imu: None takes the IMU where there is one.

    Raises:
        UsageError: A file is missing or broken, or there is no such camera or IMU.
    """
    folder = _asl(folder)
    stereo = _takes(folder / "cam1" / "sensor.yaml", None if camera is None else camera == "stereo", "cam1")
    has_imu = _takes(folder / "imu0" / "sensor.yaml", imu, "imu0")
    cameras = [read_euroc_camera(folder / "cam0" / "sensor.yaml", "left")]
    paths, stamps_s = _euroc_images(folder / "cam0")
    rights: list[Path] | None = None
    notes: tuple[str, ...] = ()
    if stereo:
        cameras.append(read_euroc_camera(folder / "cam1" / "sensor.yaml", "right"))
        others, others_s = _euroc_images(folder / "cam1")
        pairs, notes = _pairs(stamps_s, others_s, folder.parent.name)
        paths, stamps_s = [paths[row] for row, _ in pairs], stamps_s[[row for row, _ in pairs]]
        rights = [others[row] for _, row in pairs]
    rig = Rig(
        cameras=tuple(cameras), imu=read_euroc_imu(folder / "imu0" / "sensor.yaml") if has_imu else None
    )
    bodies = None
    if (folder / _EUROC_TRUTH).is_file():
        lines = [row[:8] for row in _csv(folder / _EUROC_TRUTH, 8)]
        values = read_numbers(folder / _EUROC_TRUTH, [word for row in lines for word in row]).reshape(-1, 8)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, 3] = values[:, 1:4]
        poses[:, :3, :3] = [from_quaternion(xyzw) for xyzw in values[:, [5, 6, 7, 4]]]
        bodies = Trajectory(values[:, 0] / 1e9, poses)
    name = folder.parent.name if folder.name == "mav0" else folder.name
    samples = None
    if has_imu:
        rows = [row[:7] for row in _csv(folder / "imu0" / "data.csv", 7)]
        values = read_numbers(folder / "imu0" / "data.csv", [word for row in rows for word in row])
        samples = values.reshape(-1, 7)
        samples[:, 0] /= 1e9
    files = _Files(lefts=paths, rights=rights, stamps_s=stamps_s, notes=notes)
    return _dataset(name or folder.name, rig, files, bodies, samples)


def open_kitti(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the frames of ``image_0``, or of both grey cameras.

    The truth is in ``poses.txt``, or in ``../../poses/NAME.txt``.

    Args:
        folder: Of one sequence.
        camera: None takes both cameras where there are two.
        imu: The sequences hold none.

    Raises:
        UsageError: A file is missing or broken, or there is no such camera.
    """
    if imu:
        raise UsageError(f"{folder} has no IMU: KITTI's sequences hold none", hint="leave out --imu")
    stereo = _takes(folder / "image_1", None if camera is None else camera == "stereo", "image_1")
    stamps_s = read_numbers(folder / "times.txt", read_text(folder / "times.txt").split())
    paths = _kitti_images(folder / "image_0")
    if not paths or not len(stamps_s):
        raise UsageError(f"{folder} lacks images or times", hint="unpack the sequence again")
    paths, stamps_s = paths[: len(stamps_s)], stamps_s[: len(paths)]
    height, width = read_colour(paths[0]).shape[:2]
    rig = read_kitti_rig(folder / "calib.txt", (width, height), with_right=stereo)
    rights = None
    if stereo:
        by_name = {path.stem: path for path in _kitti_images(folder / "image_1")}
        missing = [path.name for path in paths if path.stem not in by_name]
        if missing:
            raise UsageError(
                f"{folder / 'image_1'} lacks {missing[0]}", hint="unpack the sequence again, or --camera left"
            )
        rights = [by_name[path.stem] for path in paths]
    truth = None
    known = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    path = next((each for each in known if each.is_file()), None)
    if path is not None:
        values = read_numbers(path, read_text(path).split())
        if len(values) % 12 or len(values) < 12 * len(paths):
            raise UsageError(f"{path} has not 12 numbers for each image", hint="unpack the sequence again")
        poses = np.tile(np.eye(4), (len(paths), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)[: len(paths)]
        truth = Trajectory(stamps_s, poses)
    files = _Files(lefts=paths, rights=rights, stamps_s=stamps_s)
    dataset = _dataset(folder.name, rig, files, truth, None)
    # The path that KITTI measured is that of the left camera itself, as it is rectified.
    return replace(dataset, T_body_camera=None)


def _dataset(name: str, rig: Rig, files: _Files, bodies: Trajectory | None, samples: Array | None) -> Dataset:
    """Return the frames of a rig; *bodies* is the true path of its body, *samples* ``(n, 7)`` of its IMU."""
    paths, rights, stamps_s = files.lefts, files.rights, files.stamps_s
    if not len(paths) or bool((np.diff(stamps_s) <= 0).any()):
        raise UsageError(
            f"{name} has no images, or their times do not ascend", hint="unpack the recording again"
        )
    left, right = rig.left, rig.right
    rectify = None if rights is None or right is None else Rectification(left, right)
    undistort = Undistortion(left.lens)
    camera = left.lens.camera if rectify is None else rectify.camera
    T_body_camera = left.T_body_camera if rectify is None else rectify.T_body_camera
    no_depth: npt.NDArray[np.float32] = np.zeros((camera.height, camera.width), dtype=np.float32)

    def read(row: int) -> Frame:
        rgb, stamp_s = read_colour(paths[row]), float(stamps_s[row])
        if rectify is None or rights is None:
            return Frame(timestamp_s=stamp_s, rgb=undistort.colour(rgb), depth_m=no_depth, camera=camera)
        cv2 = load_opencv()
        gray = cv2.cvtColor(read_colour(rights[row]), cv2.COLOR_RGB2GRAY)
        return Frame(
            timestamp_s=stamp_s,
            rgb=rectify.left(rgb),
            depth_m=no_depth,
            camera=camera,
            stereo=rectify.right(gray),
        )

    track = None
    if samples is not None and rig.imu is not None:
        track = ImuTrack(
            samples[:, 0] - left.time_offset_s,
            np.ascontiguousarray(samples[:, 1:4]),
            np.ascontiguousarray(samples[:, 4:7]),
            rig.imu.model(T_body_camera),
        )
    truth = None
    if bodies is not None:
        truth = Trajectory(bodies.timestamps_s, bodies.T_world_camera @ T_body_camera)
    return Dataset(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamps_s.tolist()),
        truth=truth,
        truth_kind="none" if truth is None else "ground truth",
        rows=tuple(range(len(paths))),
        read=read,
        notes=files.notes,
        has_depth=False,
        has_stereo=rectify is not None,
        T_body_camera=T_body_camera,
        imu=track,
    )


def _pairs(lefts_s: Array, rights_s: Array, name: str) -> tuple[list[tuple[int, int]], tuple[str, ...]]:
    """Return rows of images that were taken together, and a note where a camera lost some."""
    pairs = pair_stamps(lefts_s, rights_s, _MAX_PAIR_S)
    if not pairs:
        raise UsageError(
            f"no image of {name}'s cam0 has one of cam1 within {1e3 * _MAX_PAIR_S:g} ms: "
            "the cameras are not synchronised",
            hint="check data.csv of both, or take one camera: --camera left",
        )
    alone = len(lefts_s) - len(pairs)
    note = f"{alone} of {len(lefts_s)} images of {name}'s left camera have no right one, and are left out"
    return pairs, (note,) if alone else ()


def _takes(path: Path, wanted: bool | None, name: str) -> bool:
    if wanted and not path.exists():
        option = "--imu" if name == "imu0" else "--camera stereo"
        raise UsageError(
            f"{path.parent if path.name == name else path.parent.parent} has no {name}",
            hint=f"unpack it, or leave out {option}",
        )
    return path.exists() if wanted is None else wanted


def _asl(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _euroc_images(folder: Path) -> tuple[list[Path], Array]:
    rows = _csv(folder / "data.csv", 2)
    stamps_s = read_numbers(folder / "data.csv", [row[0] for row in rows]) / 1e9
    names = [row[1].strip() for row in rows]
    outside = [name for name in names if Path(name).name != name]
    if outside:
        raise UsageError(
            f"{folder / 'data.csv'} names {outside[0]!r}, which is no image of its folder data",
            hint="write the name of a file alone",
        )
    return [folder / "data" / name for name in names], stamps_s


def _kitti_images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix in (".png", ".jpg"))


def _csv(path: Path, columns: int) -> list[list[str]]:
    """Return the rows of a table of EuRoC; a line that begins with ``#`` is a heading."""
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    rows = [line.split(",") for line in lines]
    if any(len(row) < columns for row in rows):
        raise UsageError(f"{path} has a row of less than {columns} values", hint="unpack it again")
    return rows
