"""Open whatever gives frames, by one word: a device, a video, a folder, a recording, a RealSense camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from client_sdk.cameras.folder import open_folder
from client_sdk.cameras.opencv_video import is_video_file, open_video
from client_sdk.cameras.pairs import open_pair_folder, open_pair_videos, split_pairs
from client_sdk.cameras.realsense import open_realsense, open_realsense_stereo
from client_sdk.cameras.source import (
    FrameStream,
    RawFrame,
    RawPair,
    RawSource,
    SourceInfo,
    StereoSource,
    no_depth,
)
from client_sdk.datasets import CameraChoice, open_dataset
from client_sdk.datasets.rig_recordings import is_euroc, is_kitti
from client_sdk.frontend import Frame
from client_sdk.rigs.intrinsics import Intrinsics, read_intrinsics
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import read_calibration, read_rig
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

__all__ = ["is_recording", "open_camera", "source_of_frames"]

_ROS = {".mcap", ".db3"}


def open_camera(
    source: Path | str | int,
    *,
    intrinsics: Intrinsics | Rig | Path | str | None = None,
    rate_hz: float | None = None,
    depth: bool = True,
    camera: CameraChoice | None = None,
    imu: bool | None = None,
) -> FrameStream:
    """Return the frames of *source* as an iterator; close it, or use it in ``with``.

    Args:
        source: ``0`` (a device), a video, a stream ``rtsp://...``, a folder of images, a recording of
            `open_dataset`, ``realsense``, or the ``.bag`` of a RealSense camera.  Stereo: two devices
            ``0,2`` or videos ``LEFT,RIGHT``, one that gives both images side by side, a folder with ``left/``
            and ``right/``, or ``realsense-stereo``.
        intrinsics: Of the camera, or the file ``intrinsics.json``; of two cameras a rig, or ``rig.json``.
            Folders and recordings may have their own.
        rate_hz: Leave frames out so that so many per second remain; all of a source at this rate or a lower.
        depth: False leaves the depth out.
        camera: ``left`` takes one camera of a rig; None takes both where there are two.
        imu: Whether frames carry samples of an IMU; None for yes where there is one.

    Raises:
        UsageError: There is no such source, or its intrinsics are missing.
        MissingExtra: A package for this kind of source is not installed.
    """
    word = str(source)
    path = Path(word)
    own = read_calibration(intrinsics) if isinstance(intrinsics, Path | str) else intrinsics
    if word == "realsense-stereo":
        pairs, rig, close = open_realsense_stereo()
        return _pair(word, pairs, own if isinstance(own, Rig) else rig, rate_hz, camera, close)
    if (path / "left").is_dir() and (path / "right").is_dir():
        rig = own if isinstance(own, Rig) else read_rig(path / "rig.json")
        return _pair(word, open_pair_folder(path), rig, rate_hz, camera)
    if word == "realsense" or path.suffix == ".bag":
        raw, factory, close = open_realsense(None if word == "realsense" else path)
        lens = own if isinstance(own, Intrinsics) else factory
        return RawSource(
            word, _without_depth(raw, depth), lens, has_depth=depth, rate_hz=rate_hz, close=close
        )
    if path.suffix in _ROS or (path / "metadata.yaml").is_file():
        raise UsageError(
            f"{word} is a ROS bag",
            hint="read it with rse-pf map from-bag (extra bags)",
        )
    if is_recording(path):
        if intrinsics is not None and not isinstance(intrinsics, Path | str):
            raise UsageError(f"{path} is a recording", hint="name a file of intrinsics, or leave it out")
        dataset = open_dataset(path, camera=camera, imu=imu, intrinsics=intrinsics)
        dataset.check()
        dataset = dataset if rate_hz is None else dataset.thinned(rate_hz)
        return source_of_frames(
            word, dataset, dataset.camera,
            has_depth=depth and dataset.has_depth, has_stereo=dataset.has_stereo,
        )  # fmt: skip
    if isinstance(own, Rig):
        return _stereo_video(word, own, rate_hz, camera)
    if camera == "stereo":
        raise UsageError(f"{word} is one camera", hint="name a rig: --intrinsics rig.json")
    if imu:
        raise UsageError(f"{word} has no IMU", hint="leave out --imu")
    if path.is_dir():
        own = own or read_intrinsics(path / "intrinsics.json")
        raw, has_depth = open_folder(path, own.depth_scale)
        has_depth = has_depth and depth
        return RawSource(word, _without_depth(raw, has_depth), own, has_depth=has_depth, rate_hz=rate_hz)
    if word.count(",") == 1 and not path.exists():
        raise UsageError(
            f"{word} names two cameras, and no rig",
            hint=f"rse-pf camera calibrate --stereo {word.replace(',', ' ')}; then --intrinsics rig.json",
        )
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
    has_stereo: bool = False,
    close: Callable[[], None] | None = None,
) -> FrameStream:
    """Return frames that are undistorted and registered already as a source; *close* releases their file."""
    blank = no_depth(camera)

    def make(item: tuple[float, Frame]) -> Frame:
        return item[1] if has_depth else replace(item[1], depth_m=blank)

    about = SourceInfo(name=name, camera=camera, has_depth=has_depth, has_stereo=has_stereo)
    return FrameStream(about, ((frame.timestamp_s, frame) for frame in frames), make, close=close)


def is_recording(path: Path) -> bool:
    """Say whether a path is a recording that lists its images, or a labelled file."""
    is_listed = (path / "depth.txt").is_file() or any(path.glob("d-*.pgm"))
    return path.suffix == ".mat" or is_listed or is_euroc(path) or is_kitti(path)


def _stereo_video(word: str, rig: Rig, rate_hz: float | None, camera: CameraChoice | None) -> FrameStream:
    """Return two devices or videos, or one whose images show both cameras side by side."""
    if word.count(",") == 1:
        pairs, close = open_pair_videos(*word.split(","))
    else:
        raw, close = open_video(word)
        pairs = split_pairs(raw, word)
    return _pair(word, pairs, rig, rate_hz, camera, close)


def _pair(
    name: str,
    pairs: Iterator[RawPair],
    rig: Rig,
    rate_hz: float | None,
    camera: CameraChoice | None,
    close: Callable[[], None] | None = None,
) -> FrameStream:
    if camera == "left":
        lefts = ((stamp, left, None) for stamp, left, _ in pairs)
        return RawSource(name, lefts, rig.left.lens, has_depth=False, rate_hz=rate_hz, close=close)
    return StereoSource(name, pairs, rig, rate_hz=rate_hz, close=close)


def _without_depth(raw: Iterator[RawFrame], has_depth: bool) -> Iterator[RawFrame]:
    return raw if has_depth else ((stamp, rgb, None) for stamp, rgb, _ in raw)
