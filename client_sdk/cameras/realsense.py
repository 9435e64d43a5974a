"""Open Intel RealSense cameras, and ``.bag`` files that they recorded: colour with depth, or infrared stereo.

librealsense aligns depth to the colour image, and states the intrinsics.  The infrared cameras are used with
the projector off, because its dots move with the camera, and would look like a scene in which the camera is
stationary.  This module is tested with a stand-in of ``pyrealsense2`` only, not on a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.cameras.source import RawFrame, RawPair
from client_sdk.datasets.images import colour_of
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import Rig, RigCamera
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.geometry import Camera, inverse

__all__ = ["open_realsense", "open_realsense_stereo"]

_SIZE = (640, 480)  # width and height of the images that the camera is asked for, px
_RATE_HZ = 30  # images a second that the camera is asked for
_TIMEOUT_MS = 5000  # wait for an image, after which a camera counts as disconnected, or a recording ends


def open_realsense(bag: Path | None = None) -> tuple[Iterator[RawFrame], Intrinsics, Callable[[], None]]:
    """Open the colour and depth images of the first RealSense camera, or of a *bag* that a camera recorded.

    Returns:
        The images with their depth, the intrinsics of the colour camera, and the function that closes the
        camera or the recording.

    Raises:
        MissingExtra: ``pyrealsense2`` is not installed.
        UsageError: There is no camera, or no such recording.
    """
    rs = _load()
    if bag is not None and not bag.is_file():
        raise UsageError(f"there is no recording {bag}", hint="name a .bag file of a RealSense camera")
    config = rs.config()
    if bag is not None:
        config.enable_device_from_file(str(bag), False)  # once, not in a loop
    else:
        config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _RATE_HZ)
        config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _RATE_HZ)
    pipeline, profile = _start_pipeline(rs, config, str(bag or "no RealSense camera"))
    if bag is not None:
        profile.get_device().as_playback().set_real_time(False)
    lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    unit_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
    intrinsics = _intrinsics_of(rs, lens, 1.0 / unit_m)
    return _images(rs, pipeline, unit_m, is_file=bag is not None), intrinsics, pipeline.stop


def open_realsense_stereo() -> tuple[Iterator[RawPair], Rig, Callable[[], None]]:
    """Open the two infrared cameras of the first RealSense camera as a stereo pair.

    Returns:
        The pairs of images, the rig (its body is the left camera), and the function that closes the camera.

    Raises:
        MissingExtra: ``pyrealsense2`` is not installed.
        UsageError: There is no camera.
    """
    rs = _load()
    config = rs.config()
    for side in (1, 2):
        config.enable_stream(rs.stream.infrared, side, *_SIZE, rs.format.y8, _RATE_HZ)
    pipeline, profile = _start_pipeline(rs, config, "no RealSense camera")
    profile.get_device().first_depth_sensor().set_option(rs.option.emitter_enabled, 0)
    left, right = (profile.get_stream(rs.stream.infrared, side).as_video_stream_profile() for side in (1, 2))
    extrinsics = left.get_extrinsics_to(right)
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = np.array(extrinsics.rotation).reshape(3, 3).T  # librealsense: column after column
    T_right_left[:3, 3] = extrinsics.translation
    cameras = (
        RigCamera(
            name="left", lens=_intrinsics_of(rs, left.get_intrinsics(), 1000.0), T_body_camera=np.eye(4)
        ),
        RigCamera(
            name="right",
            lens=_intrinsics_of(rs, right.get_intrinsics(), 1000.0),
            T_body_camera=inverse(T_right_left),
        ),
    )
    return _pairs(pipeline), Rig(cameras=cameras), pipeline.stop


def _load() -> Any:
    try:
        import pyrealsense2 as rs
    except ImportError as error:
        raise MissingExtra("pyrealsense2", "realsense") from error
    return rs


def _start_pipeline(rs: Any, config: Any, name: str) -> tuple[Any, Any]:
    pipeline = rs.pipeline()
    try:
        return pipeline, pipeline.start(config)
    except RuntimeError as error:
        raise UsageError(
            f"{name} cannot be opened: {error}", hint="check the cable: USB 3 is needed"
        ) from error


def _intrinsics_of(rs: Any, lens: Any, depth_scale: float) -> Intrinsics:
    """Return the intrinsics of *lens*, an ``rs.intrinsics``; *depth_scale* are the depth units in a metre.

    Only coefficients of the model Brown-Conrady are used; images of any other model are taken as undistorted.
    """
    camera = Camera(
        fx=lens.fx, fy=lens.fy, cx=lens.ppx, cy=lens.ppy, width=int(lens.width), height=int(lens.height)
    )
    is_distorted = lens.model == rs.distortion.brown_conrady
    return Intrinsics(
        camera=camera, distortion=tuple(lens.coeffs) if is_distorted else (), depth_scale=depth_scale
    )


def _pairs(pipeline: Any) -> Iterator[RawPair]:
    while True:
        try:
            frames = pipeline.wait_for_frames(_TIMEOUT_MS)
        except RuntimeError as error:
            raise UsageError("the RealSense camera gives no more images", hint="check its cable") from error
        left, right = frames.get_infrared_frame(1), frames.get_infrared_frame(2)
        if left and right:
            left_rgb, right_rgb = (
                colour_of(np.array(frame.get_data(), dtype=np.uint8), "realsense") for frame in (left, right)
            )
            yield float(left.get_timestamp()) / 1e3, left_rgb, right_rgb


def _images(rs: Any, pipeline: Any, unit_m: float, *, is_file: bool) -> Iterator[RawFrame]:
    align = rs.align(rs.stream.color)
    while True:
        try:
            frames = align.process(pipeline.wait_for_frames(_TIMEOUT_MS))
        except RuntimeError as error:
            if is_file:  # the end of a recording
                return
            raise UsageError("the RealSense camera gives no more images", hint="check its cable") from error
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        if colour and depth:
            rgb = np.array(colour.get_data(), dtype=np.uint8)
            depth_m = np.asarray(depth.get_data()).astype(np.float32) * np.float32(unit_m)
            yield float(colour.get_timestamp()) / 1e3, rgb, depth_m
