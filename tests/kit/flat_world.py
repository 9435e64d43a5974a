"""Three textured planes in front of a camera that moves sideways, with exact images and depths."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.mapper import Mapper
from rse_pf.geometry import Camera

__all__ = ["CAMERA", "DEPTHS_M", "STEP_M", "covered", "foreign", "frame_at", "tracked"]

CAMERA = Camera(fx=500.0, fy=500.0, cx=159.5, cy=119.5, width=320, height=240)
DEPTHS_M = (2.0, 4.0 / 3.0, 1.0)
_STEP_PX = np.array([8, 12, 16])
STEP_M = 8 * 2.0 / 500.0
"""How far the camera moves to the right from one frame to the next."""
_TEXTURE = np.kron(np.random.default_rng(5).integers(0, 256, (60, 240)), np.ones((6, 6))).astype(np.uint8)


def frame_at(row: int, *, depth: bool) -> Frame:
    """Return frame *row*; without *depth* all its readings are 0."""
    bands = [
        _TEXTURE[100 * band : 100 * band + 80, 40 + shift * row : 360 + shift * row]
        for band, shift in enumerate(_STEP_PX)
    ]
    rgb = np.repeat(np.vstack(bands)[..., None], 3, axis=2)
    depth_m = np.repeat(np.float32(DEPTHS_M), 80)[:, None] * np.ones(320, np.float32)
    return Frame(timestamp_s=row / 10, rgb=rgb, depth_m=depth_m if depth else 0.0 * depth_m, camera=CAMERA)


def foreign(frame: Frame) -> Frame:
    """Return a frame of another place: the same world as a negative, mirrored."""
    return replace(frame, rgb=np.ascontiguousarray(255 - frame.rgb[:, ::-1]))


def covered(frame: Frame) -> Frame:
    """Return what the camera sees while its lens is covered."""
    return replace(frame, rgb=np.zeros_like(frame.rgb))


def tracked(mapper: Mapper, frames: Iterable[Frame]) -> list[TrackedFrame]:
    """Return what a mapper makes of the frames."""

    async def track() -> list[TrackedFrame]:
        return [await mapper.track(frame) for frame in frames]

    return asyncio.run(track())
