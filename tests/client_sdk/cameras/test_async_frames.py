"""``async for frame in camera``: the camera is read in a thread, and the event loop goes on meanwhile."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from client_sdk.cameras import Intrinsics
from client_sdk.cameras.source import FrameSource, RawFrame, undistorted
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

INTRINSICS = Intrinsics(camera=Camera(fx=6.0, fy=6.0, cx=3.5, cy=2.5, width=8, height=6))


def source_of(raw: Iterator[RawFrame]) -> FrameSource:
    """Return a source of the frames of one camera."""
    return FrameSource(name="camera", camera=INTRINSICS.camera, frames=undistorted(raw, INTRINSICS, "camera"))


async def test_all_frames_come_while_the_loop_goes_on() -> None:
    go_on = threading.Event()

    def slow_camera() -> Iterator[RawFrame]:
        for row in range(3):
            assert go_on.wait(10), "the event loop waited for the camera"
            go_on.clear()
            yield float(row), np.zeros((6, 8, 3), np.uint8), None

    source = source_of(slow_camera())
    stamps = []
    asyncio.get_running_loop().call_soon(go_on.set)
    async for frame in source:
        stamps.append(frame.timestamp_s)
        asyncio.get_running_loop().call_soon(go_on.set)
    assert stamps == [0.0, 1.0, 2.0]


def test_a_frame_that_cannot_be_used_is_refused_there_as_well() -> None:
    wrong = iter([(0.0, np.zeros((7, 8, 3), np.uint8), None)])

    async def read() -> None:
        async for _ in source_of(wrong):
            raise AssertionError

    with pytest.raises(UsageError, match="images of 8x7 px"):
        asyncio.run(read())
