"""Write frames as a recording in TUM layout, with its true poses."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from client_sdk.frontend import Frame
from client_sdk.trajectory import Trajectory, write_trajectory

__all__ = ["write_tum"]


def write_tum(folder: Path, frames: Iterable[Frame], truth: Trajectory, depth_scale: float = 1000.0) -> None:
    """Write *frames* with depth in mm, *truth*, and intrinsics that state *depth_scale*."""
    names = {"rgb": "", "depth": ""}
    for kind in names:
        (folder / kind).mkdir(parents=True)
    for row, frame in enumerate(frames):
        images = {"rgb": frame.rgb[:, :, ::-1], "depth": np.rint(1000 * frame.depth_m).astype(np.uint16)}
        for kind, image in images.items():
            cv2.imwrite(str(folder / kind / f"{row:03}.png"), image)
            names[kind] += f"{frame.timestamp_s:.4f} {kind}/{row:03}.png\n"
        camera = {name: getattr(frame.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    for kind, lines in names.items():
        (folder / f"{kind}.txt").write_text(lines)
    write_trajectory(folder / "groundtruth.txt", truth)
    (folder / "intrinsics.json").write_text(json.dumps({**camera, "depth_scale": depth_scale}))
