"""Rigs as EuRoC (``sensor.yaml``) and KITTI (``calib.txt``) write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from client_sdk.rigs.intrinsics import Intrinsics, parse_lens_model
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import Array, Camera

__all__ = [
    "number_list",
    "read_euroc_camera",
    "read_euroc_imu",
    "read_kitti_rig",
    "read_numbers",
    "read_text",
]

_MAX_BYTES = 64 << 20


def read_euroc_camera(path: Path, name: str) -> RigCamera:
    """Return the camera of a ``sensor.yaml``; its ``T_BS`` is the pose of the camera in the body.

    Raises:
        UsageError: A number is missing or impossible.
    """
    text = read_text(path)
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
        parse_lens_model(_word_after(text, "camera_model"))  # refuses projections such as omni
        lens = Intrinsics(
            camera=camera, model=parse_lens_model(_word_after(text, "distortion_model")),
            distortion=tuple(found["distortion_coefficients"]),
        )  # fmt: skip
        return RigCamera(name=name, lens=lens, T_body_camera=np.array(pose).reshape(4, 4))
    except (InvalidCamera, UsageError) as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error


def read_euroc_imu(path: Path) -> RigImu:
    """Return the IMU of a ``sensor.yaml``.

    Raises:
        UsageError: A number is missing or impossible.
    """
    text = read_text(path)
    pose = _list_after(text, r"^\s*data:", path)
    names = {
        "gyro_noise": "gyroscope_noise_density", "gyro_walk": "gyroscope_random_walk",
        "accel_noise": "accelerometer_noise_density", "accel_walk": "accelerometer_random_walk",
        "rate_hz": "rate_hz",
    }  # fmt: skip
    found = {field: re.search(rf"^{name}:\s*([^\s#]+)", text, re.MULTILINE) for field, name in names.items()}
    if len(pose) != 16 or None in found.values():
        raise UsageError(f"{path} is not that of an IMU", hint="unpack the recording again, or --no-imu")
    numbers = {field: float(read_numbers(path, [match[1]])[0]) for field, match in found.items() if match}
    try:
        return RigImu(T_body_imu=np.array(pose).reshape(4, 4), **numbers)
    except UsageError as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error


def read_kitti_rig(path: Path, size: tuple[int, int], keys: Sequence[str]) -> Rig:
    """Return the cameras of a ``calib.txt``, of images of *size*; the body is the left grey one.

    *keys* are the names of the projections, such as ``P0`` and ``P1``, the left camera first.

    Raises:
        UsageError: A number is missing or impossible.
    """
    lines = dict(line.split(":", 1) for line in read_text(path).splitlines() if ":" in line)
    cameras = []
    for key, name in zip(keys, ("left", "right"), strict=False):
        numbers = number_list(path, lines.get(key, ""))
        if len(numbers) != 12:
            raise UsageError(f"{path} lacks the 12 numbers of {key}", hint="unpack the sequence again")
        projection = np.array(numbers).reshape(3, 4)
        try:
            camera = Camera(
                fx=numbers[0], fy=numbers[5], cx=numbers[2], cy=numbers[6], width=size[0], height=size[1]
            )
            T_left_camera = np.eye(4)
            # P = K [I | t], and t moves points of the left camera into this one.
            T_left_camera[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
            cameras.append(RigCamera(name=name, lens=Intrinsics(camera=camera), T_body_camera=T_left_camera))
        except (InvalidCamera, UsageError) as error:
            raise UsageError(f"{path}: {error.message}", hint=error.hint) from error
        except np.linalg.LinAlgError as error:
            raise UsageError(f"{path}: {key} is no camera", hint="unpack the sequence again") from error
    return Rig(cameras=tuple(cameras))


def read_text(path: Path) -> str:
    """Return the text of a file of a recording; raises UsageError."""
    try:
        return read_regular_file(path, _MAX_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}", hint="unpack the recording again") from error


def number_list(path: Path, text: str) -> list[float]:
    """Return the numbers of a text that stand between spaces or commas; raises UsageError."""
    numbers: list[float] = read_numbers(path, text.replace(",", " ").split()).tolist()
    return numbers


def read_numbers(path: Path, words: Sequence[str]) -> Array:
    """Return words of a file as finite numbers, or raise UsageError."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise UsageError(f"{path} holds a word that is no number", hint="unpack it again") from error
    if not np.isfinite(values).all():
        raise UsageError(f"{path} holds a number that is not finite", hint="unpack it again")
    return values


def _word_after(text: str, field: str) -> str | None:
    """Return the value of a field that is one word, in quotes or not; None without it."""
    found = re.search(rf"^{field}:\s*['\"]?([\w-]+)", text, re.MULTILINE)
    return None if found is None else found[1]


def _list_after(text: str, heading: str, path: Path) -> list[float]:
    found = re.search(rf"{heading}\s*\[([^\]]*)\]", text, re.MULTILINE)
    return [] if found is None else number_list(path, found[1])
