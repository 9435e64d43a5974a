"""Bags of rendered drives: encodings of one camera with depth, and a stereo pair with an IMU."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from client_sdk.bags import BagWriter
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, IMU
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import write_rig
from client_sdk.simulator.drive import render_frames
from client_sdk.simulator.world import DEPTH_M, ROOM_M, make_world
from rse_pf.geometry import inverse
from tests.kit.inertial_drive import InertialDrive, Motion, SimulatedImu
from tests.kit.rendered_rig import RenderedRig, render_raw, rendered_rig
from tests.kit.small_bags import camera_info, compressed, raw_image, stamp_of

__all__ = ["ENCODINGS", "STEREO", "write_encodings", "write_stereo"]

ENCODINGS = {
    "raw": ("/camera/image_raw", "/camera/depth"),
    "jpeg": ("/camera/image_raw/compressed", "/camera/depth/compressedDepth"),
    "png": ("/camera/png/compressed", "/camera/metres"),
}
"""Topics of colour and depth: rgb8 and 16UC1, JPEG and compressedDepth, PNG and 32FC1."""
STEREO = {
    "colour": "/left/image_raw", "info": "/left/camera_info", "right": "/right/image_raw",
    "right_info": "/right/camera_info", "depth": "",
}  # fmt: skip
_SEED = 303
_IMU_EARLY_S = 0.2


def write_encodings(path: Path, frames: int) -> None:
    """Write a drive of one camera with depth, each image in all of `ENCODINGS`."""
    with BagWriter(path, "mcap") as w:
        for row, frame in enumerate(render_frames(0, 1, frames, seed=0)):
            stamp, camera, bgr = stamp_of(row), frame.camera, frame.rgb[:, :, ::-1]
            millimetres = np.round(1000 * frame.depth_m).astype(np.uint16)
            jpeg, png, depth = (
                cv2.imencode(end, image)[1].tobytes()
                for end, image in ((".jpg", bgr), (".png", bgr), (".png", millimetres))
            )
            images = {
                "/camera/image_raw": raw_image(w, stamp, frame.rgb, "rgb8"),
                "/camera/depth": raw_image(w, stamp, millimetres, "16UC1"),
                "/camera/image_raw/compressed": compressed(w, stamp, jpeg, "rgb8; jpeg compressed bgr8"),
                "/camera/depth/compressedDepth": compressed(
                    w, stamp, struct.pack("<iff", 0, 0.0, 0.0) + depth, "16UC1; compressedDepth png"
                ),
                "/camera/png/compressed": compressed(w, stamp, png, "rgb8; png compressed bgr8"),
                "/camera/metres": raw_image(w, stamp, frame.depth_m.astype(np.float32), "32FC1"),
            }
            info = camera_info(w, stamp, k=camera.matrix.ravel(), width=camera.width, height=camera.height)
            w.write("/camera/camera_info", CAMERA_INFO, stamp, info)
            for topic, image in images.items():
                kind = COMPRESSED_IMAGE if "compressed" in topic else IMAGE
                w.write(topic, kind, stamp, image)


def write_stereo(path: Path, rig_file: Path, frames: int) -> None:
    """Write a drive of two distorted lenses and an IMU of 200 Hz at 10 Hz, and the file of its rig."""
    rig = rendered_rig()
    write_rig(rig_file, Rig(cameras=(rig.left, rig.right), imu=rig.imu))
    motion = Motion(reach_m=0.5, turn_rad=0.35, slowest_hz=0.08, fastest_hz=0.3)
    drive = InertialDrive(rig.imu.model(rig.left.T_body_camera), motion, _SEED)
    stamps_s = np.arange(frames) / 10.0
    T_world_left = drive.T_world_camera(stamps_s)
    T_world_left[:, :3, 3] += [0.5 * ROOM_M, 0.5 * DEPTH_M, 1.45]
    T_world_body = T_world_left @ inverse(rig.left.T_body_camera)
    samples = SimulatedImu(drive, frames / 10.0, _SEED).between(-_IMU_EARLY_S, frames / 10.0)
    with BagWriter(path, "mcap") as w:
        messages: list[tuple[int, str, str, Any]] = [
            (stamp_of(0) + round(1e9 * s), "/imu", IMU, (gyro, accel))
            for s, gyro, accel in zip(samples.timestamps_s, samples.gyro, samples.accel, strict=True)
        ]
        infos = dict(zip(("left", "right"), _infos(rig), strict=True))
        for row, pair in enumerate(render_raw(rig, make_world(_SEED), T_world_body, _SEED)):
            for side, image in zip(("left", "right"), pair, strict=True):
                messages += [
                    (stamp_of(row), f"/{side}/camera_info", CAMERA_INFO, infos[side]),
                    (stamp_of(row), f"/{side}/image_raw", IMAGE, image),
                ]
        for stamp, topic, kind, content in sorted(messages, key=lambda each: each[0]):
            if kind == IMU:
                message = w.imu(stamp, "imu_link", *content)
            elif kind == CAMERA_INFO:
                message = camera_info(w, stamp, **content)
            else:
                message = raw_image(w, stamp, content, "rgb8")
            w.write(topic, kind, stamp, message)


def _infos(rig: RenderedRig) -> list[dict[str, Any]]:
    """Return the fields of both ``CameraInfo``, with R and P as ROS's calibration writes them."""
    lens: Intrinsics = rig.left.lens
    camera, distortion = lens.camera, np.array([*lens.distortion, 0.0])
    T_right_left = inverse(rig.right.T_body_camera) @ rig.left.T_body_camera
    size = (camera.width, camera.height)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        camera.matrix, distortion, camera.matrix, distortion, size, T_right_left[:3, :3], T_right_left[:3, 3]
    )
    return [
        {
            "k": camera.matrix.ravel(), "distortion": distortion, "r": R.ravel(), "p": P.ravel(),
            "width": size[0], "height": size[1],
        }
        for R, P in ((R_left, P_left), (R_right, P_right))
    ]  # fmt: skip
