"""Open whatever gives frames, by one word: a device, a video, a folder, a recording, a RealSense camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from client_sdk.cameras.folder import open_folder
from client_sdk.cameras.opencv_video import is_video_file, open_video
from client_sdk.cameras.realsense import open_realsense
from client_sdk.cameras.source import RawFrame, RawSource
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame
from client_sdk.rigs.intrinsics import Intrinsics, read_intrinsics
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = ["open_camera", "source_of_frames"]

_ROS = {".mcap", ".db3"}


def open_camera(
    source: Path | str | int,
    *,
    intrinsics: Intrinsics | Path | str | None = None,
    rate_hz: float | None = None,
    depth: bool = True,
) -> RawSource:
    """Return the frames of *source* as an iterator; close it, or use it in ``with``.

    Args:
        source: ``0`` (a device), a video, a stream ``rtsp://...``, a folder of images, a recording in TUM
            layout or of NYU, ``realsense``, or the ``.bag`` of a RealSense camera.
        intrinsics: Of the camera, or the file ``intrinsics.json``; folders and recordings may have their own.
        rate_hz: Leave frames out so that so many per second remain; all of a source at this rate or a lower.
        depth: False leaves the depth out.

    Raises:
        UsageError: There is no such source, or its intrinsics are missing.
        MissingExtra: A package for this kind of source is not installed.
    """
    word = str(source)
    path = Path(word)
    own = (
        intrinsics
        if isinstance(intrinsics, Intrinsics) or intrinsics is None
        else read_intrinsics(intrinsics)
    )
    if word == "realsense" or path.suffix == ".bag":
        raw, factory, close = open_realsense(None if word == "realsense" else path)
        return RawSource(
            word, _without_depth(raw, depth), own or factory, has_depth=depth, rate_hz=rate_hz, close=close
        )
    if path.suffix in _ROS or (path / "metadata.yaml").is_file():
        raise UsageError(
            f"{word} is a ROS bag",
            hint="read it with rse-pf map from-bag (extra bags)",
        )
    if path.suffix == ".mat" or (path / "depth.txt").is_file() or any(path.glob("d-*.pgm")):
        return _recording(path, own, rate_hz, depth)
    if path.is_dir():
        own = own or read_intrinsics(path / "intrinsics.json")
        raw, has_depth = open_folder(path, own.depth_scale)
        has_depth = has_depth and depth
        return RawSource(word, _without_depth(raw, has_depth), own, has_depth=has_depth, rate_hz=rate_hz)
    is_video_file(word)  # a name that is wrong is told before intrinsics that are missing
    if own is None:
        raise UsageError(
            f"the intrinsics of {word} are not known",
            hint="show this camera a board, and calibrate it once: rse-pf camera calibrate 0 (or BOARD.mp4); "
            "or write the file by hand (docs/cameras.md); then --intrinsics intrinsics.json",
        )
    raw, close = open_video(word)
    return RawSource(word, raw, own, has_depth=False, rate_hz=rate_hz, close=close)


def source_of_frames(
    name: str,
    frames: Iterable[Frame],
    camera: Camera,
    *,
    has_depth: bool,
    rate_hz: float | None = None,
    close: Callable[[], None] | None = None,
) -> RawSource:
    """Return frames that are undistorted and registered already as a source; *close* releases their file.

    Raises:
        UsageError: The rate is not above 0.
    """
    raw = _without_depth(map(_as_raw, frames), has_depth)
    plain = Intrinsics(camera=camera)
    return RawSource(name, raw, plain, has_depth=has_depth, rate_hz=rate_hz, close=close)


def _recording(path: Path, own: Intrinsics | None, rate_hz: float | None, depth: bool) -> RawSource:
    """Return a recording; its frames are undistorted and registered already."""
    dataset = open_dataset(path)
    if own is not None and own.camera != dataset.camera:
        raise UsageError(
            f"{path} has intrinsics of its own, and they differ", hint="leave --intrinsics out for recordings"
        )
    dataset = dataset if rate_hz is None else dataset.thinned(rate_hz)
    return source_of_frames(str(path), dataset, dataset.camera, has_depth=depth)


def _as_raw(frame: Frame) -> RawFrame:
    return frame.timestamp_s, frame.rgb, frame.depth_m.astype(np.float32, copy=False)


def _without_depth(raw: Iterator[RawFrame], has_depth: bool) -> Iterator[RawFrame]:
    return raw if has_depth else ((stamp, rgb, None) for stamp, rgb, _ in raw)
