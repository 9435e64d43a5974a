"""Read the rigs of the benchmarks EuRoC (``sensor.yaml``) and KITTI (``calib.txt``)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from client_sdk.rigs.intrinsics import Intrinsics, name_file_in_errors, parse_lens_model
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera
from rse_pf.storage.files import read_regular_file

__all__ = [
    "read_euroc_camera",
    "read_euroc_imu",
    "read_kitti_rig",
    "read_numbers",
    "read_text",
]

# Largest text file of a recording that is read, 64 MiB (the longest ones list IMU samples); a larger one is
# refused.
_MAX_FILE_BYTES = 64 << 20
_HINT = "unpack the recording again"
_EUROC_IMU_FIELDS = {
    "gyro_noise": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_noise": "accelerometer_noise_density",
    "accel_walk": "accelerometer_random_walk",
    "rate_hz": "rate_hz",
}
"""For each number of `RigImu` that a ``sensor.yaml`` states, its name in that file."""


def read_euroc_camera(path: Path, name: str) -> RigCamera:
    """Return the camera that a ``sensor.yaml`` of EuRoC describes, with the name *name*.

    The matrix ``T_BS`` of the file is ``T_body_camera``, row by row.

    Raises:
        UsageError: The file cannot be read, a number is missing or impossible, or the lens model is unknown.
    """
    text = read_text(path)
    width_height = _list_after(text, r"^resolution:", path)
    fx_fy_cx_cy = _list_after(text, r"^intrinsics:", path)
    distortion = _list_after(text, r"^distortion_coefficients:", path)
    T_body_camera = _list_after(text, r"^\s*data:", path)
    if [len(width_height), len(fx_fy_cx_cy), len(T_body_camera)] != [2, 4, 16]:
        raise UsageError(
            f"{path} does not describe a camera: it has {len(width_height)} of 2 numbers of the resolution, "
            f"{len(fx_fy_cx_cy)} of 4 of the intrinsics, {len(T_body_camera)} of 16 of T_BS",
            hint=_HINT,
        )
    (fx, fy, cx, cy), (width, height) = fx_fy_cx_cy, width_height
    with name_file_in_errors(path, _HINT):
        camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height))
        parse_lens_model(_word_after(text, "camera_model"))  # refuses projections such as omni
        lens = Intrinsics(
            camera=camera,
            model=parse_lens_model(_word_after(text, "distortion_model")),
            distortion=tuple(distortion),
        )
        return RigCamera(name=name, lens=lens, T_body_camera=np.array(T_body_camera).reshape(4, 4))


def read_euroc_imu(path: Path) -> RigImu:
    """Return the IMU that a ``sensor.yaml`` of EuRoC describes; its matrix ``T_BS`` is ``T_body_imu``.

    Raises:
        UsageError: The file cannot be read, or a number is missing or impossible.
    """
    text = read_text(path)
    T_body_imu = _list_after(text, r"^\s*data:", path)
    names = _EUROC_IMU_FIELDS.values()
    matches = (re.search(rf"^{name}:\s*([^\s#]+)", text, re.MULTILINE) for name in names)
    words = {field: match[1] for field, match in zip(_EUROC_IMU_FIELDS, matches, strict=True) if match}
    missing = [name for field, name in _EUROC_IMU_FIELDS.items() if field not in words]
    if len(T_body_imu) != 16 or missing:
        raise UsageError(
            f"{path} does not describe an IMU: it holds {len(T_body_imu)} of 16 numbers of T_BS"
            + (f", and no {missing[0]}" if missing else ""),
            hint="unpack the recording again, or --no-imu",
        )
    numbers = {field: float(read_numbers(path, [word])[0]) for field, word in words.items()}
    with name_file_in_errors(path, _HINT):
        return RigImu(T_body_imu=np.array(T_body_imu).reshape(4, 4), **numbers)


def read_kitti_rig(path: Path, size: tuple[int, int], projection_names: Sequence[str]) -> Rig:
    """Return the rectified cameras of a ``calib.txt`` of KITTI.

    The frame of the body is that of the camera with the projection matrix ``P0``.

    Args:
        path: The file ``calib.txt``.
        size: Width and height of the images, px, which the file does not state.
        projection_names: Names of one or two projection matrices in the file, such as ``P0`` and ``P1``; the
            first one is that of the left camera.

    Raises:
        UsageError: The file cannot be read, or a number is missing or impossible.
    """
    lines = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
    cameras = []
    for projection_name, name in zip(projection_names, ("left", "right"), strict=False):
        numbers = read_numbers(path, lines.get(projection_name, "").split()).tolist()
        if len(numbers) != 12:
            raise UsageError(
                f"{path} has {len(numbers)} of the 12 numbers of {projection_name}",
                hint=_HINT,
            )
        projection = np.array(numbers).reshape(3, 4)
        with name_file_in_errors(path, _HINT):
            camera = Camera(
                fx=numbers[0], fy=numbers[5], cx=numbers[2], cy=numbers[6], width=size[0], height=size[1]
            )
            T_body_camera = np.eye(4)
            # P = K [I | t]: the images are rectified, so that no camera is rotated against the body, and a
            # point x of the body is x + t in the camera.  The position of the camera in the body is therefore
            # -t.
            T_body_camera[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
            cameras.append(RigCamera(name=name, lens=Intrinsics(camera=camera), T_body_camera=T_body_camera))
    return Rig(cameras=tuple(cameras))


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file of a recording.

    Raises:
        UsageError: The file is missing, is no regular file, is larger than 64 MiB, or is not UTF-8.
    """
    try:
        return read_regular_file(path, _MAX_FILE_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}", hint=_HINT) from error


def read_numbers(path: Path, words: Sequence[str]) -> Array:
    """Return words as finite numbers ``(n,)``; *path*, the file that holds them, is named in errors.

    Raises:
        UsageError: A word is no number, or a number is not finite.
    """
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise UsageError(f"{path} holds a word that is no number", hint=_HINT) from error
    if not np.isfinite(values).all():
        raise UsageError(f"{path} holds a number that is not finite", hint=_HINT)
    return values


def _word_after(text: str, field: str) -> str | None:
    """Return the value of a YAML field, one word with or without quotes; None if the field is missing."""
    match = re.search(rf"^{field}:\s*['\"]?([\w-]+)", text, re.MULTILINE)
    return None if match is None else match[1]


def _list_after(text: str, heading: str, path: Path) -> list[float]:
    """Return the numbers in the brackets after the pattern *heading* in *text*; empty if nothing matches it.

    *path* is the file of the text, which errors name.
    """
    match = re.search(rf"{heading}\s*\[([^\]]*)\]", text, re.MULTILINE)
    numbers: list[float] = read_numbers(path, match[1].replace(",", " ").split()).tolist() if match else []
    return numbers
