"""Open an Intel RealSense camera: colour images with depth, and the intrinsics of the colour camera.

librealsense aligns depth to the colour image.  This module is tested with a stand-in of ``pyrealsense2``
only, not on a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from client_sdk.cameras.source import RawFrame
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.geometry import Camera

__all__ = ["open_realsense"]

_SIZE = (640, 480)  # width and height in px to which the camera is set
_RATE_HZ = 30  # images per second to which the camera is set
_TIMEOUT_MS = 5000  # a camera that has given no image for this long is an error, as if it were disconnected
_CABLE_HINT = "check the cable: USB 3 is needed"


def open_realsense() -> tuple[Iterator[RawFrame], Intrinsics, Callable[[], None]]:
    """Open the colour and depth images of the first RealSense camera.

    Returns:
        The images with their depth, the intrinsics of the colour camera, and the function that closes the
        camera.

    Raises:
        MissingExtra: ``pyrealsense2`` is not installed.
        UsageError: There is no camera.
    """
    try:
        import pyrealsense2 as rs
    except ImportError as error:
        raise MissingExtra("pyrealsense2", "realsense") from error
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _RATE_HZ)
    config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _RATE_HZ)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise UsageError(f"no RealSense camera can be opened: {error}", hint=_CABLE_HINT) from error
    lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    unit_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
    # Coefficients of any other lens model than Brown-Conrady are not used: the images count as undistorted.
    is_distorted = lens.model == rs.distortion.brown_conrady
    intrinsics = Intrinsics(
        camera=Camera(
            fx=lens.fx, fy=lens.fy, cx=lens.ppx, cy=lens.ppy, width=int(lens.width), height=int(lens.height)
        ),
        distortion=tuple(lens.coeffs) if is_distorted else (),
        depth_scale=1.0 / unit_m,
    )
    return _images(pipeline, rs.align(rs.stream.color), unit_m), intrinsics, pipeline.stop


def _images(pipeline: Any, align: Any, unit_m: float) -> Iterator[RawFrame]:
    """Yield the images of a *pipeline*, whose depth values times *unit_m* are metres.

    Raises:
        UsageError: The camera has given no image for 5 s.
    """
    while True:
        try:
            frames = align.process(pipeline.wait_for_frames(_TIMEOUT_MS))
        except RuntimeError as error:
            raise UsageError("the RealSense camera gives no more images", hint=_CABLE_HINT) from error
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        if colour and depth:
            rgb = np.array(colour.get_data(), dtype=np.uint8)
            depth_m = np.asarray(depth.get_data()).astype(np.float32) * np.float32(unit_m)
            yield float(colour.get_timestamp()) / 1e3, rgb, depth_m
