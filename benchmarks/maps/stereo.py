"""Rectified stereo pairs as frames with depth, by block matching."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client_sdk.datasets.left_camera import open_euroc, read_euroc_camera
from client_sdk.frontend import Frame, load_opencv
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.pnp import DepthNoise

__all__ = ["StereoRecording", "euroc_stereo"]

_DISPARITIES, _BLOCK_PX = 128, 7
_DISPARITY_NOISE_PX = 0.5
_FARTHEST_M = 20.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoRecording:
    """Frames of the rectified left camera, their ``(n, 4, 4)`` true poses, and the noise of the depths."""

    frames: tuple[Frame, ...]
    T_world_camera: Array
    noise: DepthNoise


def euroc_stereo(folder: Path) -> StereoRecording:
    """Return the pairs of a recording in EuRoC's layout.

    Source:
        Hirschmueller, Stereo processing by semiglobal matching, PAMI 2008 (OpenCV).
    """
    cv2 = load_opencv()
    images = folder / "mav0"
    lenses, T_body = zip(
        *(read_euroc_camera(images / name / "sensor.yaml") for name in ("cam0", "cam1")), strict=True
    )
    left = lenses[0].camera
    size = (left.width, left.height)
    T_right_left = inverse(T_body[1]) @ T_body[0]
    models = [(lens.camera.matrix, np.array(lens.distortion)) for lens in lenses]
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        *models[0], *models[1], size, T_right_left[:3, :3], T_right_left[:3, 3],
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    charts = [
        cv2.initUndistortRectifyMap(*model, R, P, size, cv2.CV_32FC1)
        for model, R, P in zip(models, (R_left, R_right), (P_left, P_right), strict=True)
    ]
    camera = Camera(
        fx=P_left[0, 0], fy=P_left[1, 1], cx=P_left[0, 2], cy=P_left[1, 2], width=size[0], height=size[1]
    )  # fmt: skip
    focal_baseline = -float(P_right[0, 3])
    matcher = cv2.StereoSGBM_create(
        numDisparities=_DISPARITIES, blockSize=_BLOCK_PX, P1=8 * _BLOCK_PX**2, P2=32 * _BLOCK_PX**2,
        disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=100, speckleRange=1,
    )  # fmt: skip
    T_camera_rectified = np.eye(4)
    T_camera_rectified[:3, :3] = R_left.T
    truth = open_euroc(folder).truth
    assert truth is not None
    known_s = np.asarray(truth.timestamps_s)
    frames, poses = [], []
    for row in (images / "cam0/data.csv").read_text().splitlines()[1:]:
        stamp, name = (word.strip() for word in row.split(","))
        paths = [images / each / "data" / name for each in ("cam0", "cam1")]
        if not paths[1].exists():
            continue
        grey = [
            cv2.remap(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), *chart, cv2.INTER_LINEAR)
            for path, chart in zip(paths, charts, strict=True)
        ]
        disparity_px = matcher.compute(*grey).astype(np.float32) / 16.0
        depth_m = np.where(disparity_px > 0.5, focal_baseline / np.maximum(disparity_px, 0.5), 0.0)
        depth_m[depth_m > _FARTHEST_M] = 0.0
        seconds = int(stamp) / 1e9
        frames.append(
            Frame(
                timestamp_s=seconds, rgb=np.repeat(grey[0][:, :, None], 3, axis=2),
                depth_m=depth_m.astype(np.float32), camera=camera,
            )
        )  # fmt: skip
        nearest = int(np.argmin(np.abs(known_s - seconds)))
        poses.append(np.asarray(truth.T_world_camera)[nearest] @ T_camera_rectified)
    noise = DepthNoise(base_m=1e-3, growth_per_m=_DISPARITY_NOISE_PX / focal_baseline, from_m=0.0)
    return StereoRecording(frames=tuple(frames), T_world_camera=np.array(poses), noise=noise)
