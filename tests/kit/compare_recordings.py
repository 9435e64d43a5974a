"""Small recordings for tests: three planes before a camera that moves sideways, with exact poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from client_sdk.datasets import Dataset
from client_sdk.frontend import Frame
from client_sdk.trajectory import Trajectory
from tests.kit.flat_world import CAMERA, STEP_M, frame_at

__all__ = ["flat_drive"]


def flat_drive(
    frames: int = 10,
    *,
    depth: bool = True,
    has_truth: bool = True,
    change: Callable[[int, Frame], Frame] = lambda row, frame: frame,
) -> Dataset:
    """Return a drive at 10 Hz; *change* may replace its frames."""
    stamps_s = np.arange(frames) / 10
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(frames)
    return Dataset(
        name="flat",
        camera=CAMERA,
        timestamps_s=tuple(stamps_s.tolist()),
        truth=Trajectory(stamps_s, poses) if has_truth else None,
        truth_kind="ground truth" if has_truth else "none",
        rows=tuple(range(frames)),
        read=lambda row: change(row, frame_at(row, depth=depth)),
        has_depth=depth,
    )


def black(row: int, frame: Frame) -> Frame:
    """Return a black image instead of frames 4 to 6."""
    return replace(frame, rgb=np.zeros_like(frame.rgb)) if 4 <= row <= 6 else frame
