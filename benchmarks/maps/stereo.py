"""Rectified stereo pairs as frames with depth, by block matching."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from client_sdk.datasets.rig_recordings import open_euroc
from client_sdk.frontend import Frame, load_opencv
from rse_pf.geometry import Array
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
    dataset = open_euroc(folder, camera="stereo", imu=False)
    truth = dataset.truth
    assert truth is not None
    matcher = cv2.StereoSGBM_create(
        numDisparities=_DISPARITIES, blockSize=_BLOCK_PX, P1=8 * _BLOCK_PX**2, P2=32 * _BLOCK_PX**2,
        disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=100, speckleRange=1,
    )  # fmt: skip
    known_s = np.asarray(truth.timestamps_s)
    frames, poses, focal_baseline = [], [], 1.0
    for frame in dataset:
        pair = frame.stereo
        assert pair is not None
        focal_baseline = frame.camera.fx * pair.baseline_m
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        disparity_px = matcher.compute(gray, pair.gray).astype(np.float32) / 16.0
        depth_m = np.where(disparity_px > 0.5, focal_baseline / np.maximum(disparity_px, 0.5), 0.0)
        depth_m[depth_m > _FARTHEST_M] = 0.0
        frames.append(replace(frame, depth_m=depth_m.astype(np.float32), stereo=None))
        nearest = int(np.argmin(np.abs(known_s - frame.timestamp_s)))
        poses.append(np.asarray(truth.T_world_camera)[nearest])
    noise = DepthNoise(base_m=1e-3, growth_per_m=_DISPARITY_NOISE_PX / focal_baseline, from_m=0.0)
    return StereoRecording(frames=tuple(frames), T_world_camera=np.array(poses), noise=noise)
