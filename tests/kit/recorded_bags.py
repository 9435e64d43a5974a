"""A recording in TUM layout, written as a bag with CameraInfo and tf."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

from client_sdk.bags import BagKind, BagWriter
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, TF
from client_sdk.trajectory import read_trajectory
from rse_pf.geometry import to_quaternion
from tests.kit.small_bags import camera_info, compressed, raw_image, transforms

_START_NS = 1_700_000_000_000_000_000
_FRAME = "camera_optical"


def write_recording(folder: Path, path: Path, kind: BagKind, *, is_raw: bool, frames: int) -> None:
    """Write the first *frames*: raw images, or the JPEG files as they are and compressedDepth."""
    numbers = json.loads((folder / "intrinsics.json").read_text(encoding="utf-8"))
    fx, fy, cx, cy = (float(numbers[name]) for name in ("fx", "fy", "cx", "cy"))
    camera = {
        "distortion": numbers["distortion"],
        "height": int(numbers["height"]),
        "width": int(numbers["width"]),
        "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
        "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
    }
    lines = (folder / "rgb.txt").read_text(encoding="utf-8").splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")][:frames]
    truth = read_trajectory(folder / "groundtruth.txt").T_world_camera
    with BagWriter(path, kind) as w:
        for (stamp_s, name), T in zip(rows, truth, strict=False):
            stamp = _START_NS + round(1e9 * float(stamp_s))
            moved = transforms(w, stamp, "world", _FRAME, T[:3, 3], to_quaternion(T[:3, :3]))
            w.write("/tf", TF, stamp, moved)
            info = camera_info(w, stamp, frame=_FRAME, **camera)
            w.write("/camera/camera_info", CAMERA_INFO, stamp, info)
            depth = cv2.imread(str(folder / "depth" / f"{Path(name).stem}.png"), cv2.IMREAD_UNCHANGED)
            if is_raw:
                colour = raw_image(w, stamp, cv2.imread(str(folder / name)), "bgr8", _FRAME)
                w.write("/camera/image_raw", IMAGE, stamp, colour)
                w.write("/camera/aligned_depth", IMAGE, stamp, raw_image(w, stamp, depth, "16UC1", _FRAME))
            else:
                jpeg = compressed(
                    w, stamp, (folder / name).read_bytes(), "bgr8; jpeg compressed bgr8", _FRAME
                )
                w.write("/camera/image_raw/compressed", COMPRESSED_IMAGE, stamp, jpeg)
                png = struct.pack("<iff", 0, 0.0, 0.0) + cv2.imencode(".png", depth)[1].tobytes()
                message = compressed(w, stamp, png, "16UC1; compressedDepth png", _FRAME)
                w.write("/camera/aligned_depth/compressedDepth", COMPRESSED_IMAGE, stamp, message)
