"""Intel RealSense cameras, and the ``.bag`` files that they record: colour and registered depth.

Depth is aligned to the colour image by librealsense; intrinsics come from the camera.  This module is tested
with a stand-in of ``pyrealsense2`` only, not on a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.cameras.source import RawFrame
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.geometry import Camera

__all__ = ["open_realsense"]

_SIZE, _RATE_HZ = (640, 480), 30
_TIMEOUT_MS = 5000


def open_realsense(bag: Path | None = None) -> tuple[Iterator[RawFrame], Intrinsics, Callable[[], None]]:
    """Open the first RealSense camera, or a *bag* that one has recorded.

    Returns:
        Its images, its intrinsics, and how to close it.

    Raises:
        MissingExtra: ``pyrealsense2`` is not installed.
        UsageError: There is no camera, or no such recording.
    """
    try:
        import pyrealsense2 as rs
    except ImportError as error:
        raise MissingExtra("pyrealsense2", "realsense") from error
    if bag is not None and not bag.is_file():
        raise UsageError(f"there is no recording {bag}", hint="name a .bag file of a RealSense camera")
    config = rs.config()
    if bag is not None:
        config.enable_device_from_file(str(bag), False)  # once, not in a loop
    else:
        config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _RATE_HZ)
        config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _RATE_HZ)
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise UsageError(
            f"{bag or 'no RealSense camera'} cannot be opened: {error}",
            hint="check the cable: USB 3 is needed",
        ) from error
    if bag is not None:
        profile.get_device().as_playback().set_real_time(False)
    lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    camera = Camera(
        fx=lens.fx, fy=lens.fy, cx=lens.ppx, cy=lens.ppy, width=int(lens.width), height=int(lens.height)
    )
    unit_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
    distorts = lens.model == rs.distortion.brown_conrady
    intrinsics = Intrinsics(
        camera=camera, distortion=tuple(lens.coeffs) if distorts else (), depth_scale=1.0 / unit_m
    )
    return _images(rs, pipeline, unit_m, is_file=bag is not None), intrinsics, pipeline.stop


def _images(rs: Any, pipeline: Any, unit_m: float, *, is_file: bool) -> Iterator[RawFrame]:
    align = rs.align(rs.stream.color)
    while True:
        try:
            frames = align.process(pipeline.wait_for_frames(_TIMEOUT_MS))
        except RuntimeError as error:
            if is_file:  # librealsense ends a playback so
                return
            raise UsageError("the RealSense camera gives no more images", hint="check its cable") from error
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        if colour and depth:
            rgb = np.array(colour.get_data(), dtype=np.uint8)
            depth_m = np.asarray(depth.get_data()).astype(np.float32) * np.float32(unit_m)
            yield float(colour.get_timestamp()) / 1e3, rgb, depth_m
