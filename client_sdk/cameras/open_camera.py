"""Open whatever gives frames, by one word: a device, a video, a folder, a recording, a RealSense camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from client_sdk.cameras.folder import list_folder, list_pairs, pair_folders
from client_sdk.cameras.opencv_video import open_video
from client_sdk.cameras.pairs import open_pair_videos, split_pairs
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
from client_sdk.datasets.recordings import is_listed
from client_sdk.datasets.rig_recordings import is_euroc, is_kitti
from client_sdk.frontend import Frame
from client_sdk.rigs.folder_camera import find_folder_camera
from client_sdk.rigs.intrinsics import TYPICAL_HINT, Intrinsics, read_intrinsics
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import read_calibration, read_rig
from client_sdk.source_facts import CameraFacts, DoubtLog, SourceFacts, check_source
from rse_pf.errors import UsageError
from rse_pf.files import check_exists
from rse_pf.geometry import Camera

__all__ = ["is_recording", "open_camera", "source_of_frames"]

_ROS = {".mcap", ".db3"}
_REALSENSE = ("realsense", "realsense-stereo")  # words for devices
_SOURCES = "name a device by its number, a video, a folder or a recording that exists"


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
    for name in (word,) if path.exists() or word.count(",") != 1 else word.split(","):
        if not name.isdigit() and "://" not in name and name not in _REALSENSE:
            check_exists(name, _SOURCES)
    own = read_calibration(intrinsics) if isinstance(intrinsics, Path | str) else intrinsics
    stated_by = str(intrinsics) if isinstance(intrinsics, Path | str) else f"the intrinsics of {word}"
    if word == "realsense-stereo":
        pairs, rig, close = open_realsense_stereo()
        facts = SourceFacts(name=word)
        return _pair(facts, lambda log: pairs, own if isinstance(own, Rig) else rig, rate_hz, camera, close)
    if pair_folders(path) is not None:
        rig = own if isinstance(own, Rig) else read_rig(path / "rig.json")
        images = list_pairs(path, rig.left.lens.rate_hz)
        facts = images.facts(rig.left.lens, str(intrinsics or path / "rig.json"), has_depth=False)
        return _pair(facts, images.pairs, rig, rate_hz, camera)
    if word == "realsense" or path.suffix == ".bag":
        raw, factory, close = open_realsense(None if word == "realsense" else path)
        lens = own if isinstance(own, Intrinsics) else factory
        facts = _facts_of_lens(word, lens, stated_by)
        return _single(facts, lambda log: _without_depth(raw, depth), lens, rate_hz, depth, close)
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
            notes=dataset.notes, log=dataset.log, span_s=dataset.span_s,
        )  # fmt: skip
    if isinstance(own, Rig) and own.right is None:
        own = own.left.lens
    if isinstance(own, Rig) and path.is_dir():
        raise UsageError(
            f"{word} has no two folders of images, such as left/ and right/ or image_left/ and image_right/",
            hint="give the intrinsics of one camera, or name the folder above both",
        )
    if isinstance(own, Rig):
        return _stereo_video(word, own, rate_hz, camera, stated_by)
    if camera == "stereo":
        raise UsageError(f"{word} is one camera", hint="name a rig: --intrinsics rig.json")
    if imu:
        raise UsageError(f"{word} has no IMU", hint="leave out --imu")
    if path.is_dir():
        if own is None:
            file = path / "intrinsics.json"
            found = None if file.exists() else find_folder_camera(path, lambda: list_folder(path).size_px)
            file, own = (file, read_intrinsics(file)) if found is None else found
            stated_by = str(file)
        return _folder(path, own, stated_by, rate_hz, depth)
    if word.count(",") == 1 and not path.exists():
        raise UsageError(
            f"{word} names two cameras, and no rig",
            hint=f"rse-pf camera calibrate --stereo {word.replace(',', ' ')}; then --intrinsics rig.json",
        )
    if own is None:
        raise UsageError(f"the intrinsics of {word} are not known", hint=TYPICAL_HINT)
    facts = _facts_of_lens(word, own, stated_by)
    check_source(facts)  # before a device is opened
    video = open_video(word)
    facts = replace(facts, assumed=video.notes)
    return _single(facts, lambda log: video.images, own, rate_hz, False, video.close, video.span_s)


def _folder(
    path: Path, lens: Intrinsics, stated_by: str, rate_hz: float | None, use_depth: bool
) -> FrameStream:
    """Return the images of a folder, with depth where there is some and it is wanted."""
    images = list_folder(path, lens.rate_hz)
    has_depth = use_depth and images.partners is not None
    facts = images.facts(lens, stated_by, has_depth=has_depth)

    def frames(log: DoubtLog) -> Iterator[RawFrame]:
        return images.frames(log, lens.depth_units_per_m if has_depth else None)

    return _single(facts, frames, lens, rate_hz, has_depth)


def _single(
    facts: SourceFacts,
    frames: Callable[[DoubtLog], Iterator[RawFrame]],
    lens: Intrinsics,
    rate_hz: float | None,
    has_depth: bool,
    close: Callable[[], None] | None = None,
    span_s: tuple[float, float] | None = None,
) -> FrameStream:
    """Return the frames of one camera that has passed the gate."""
    log = DoubtLog(check_source(facts))
    about = SourceInfo(
        name=facts.name, camera=lens.camera, has_depth=has_depth, notes=facts.assumed, log=log,
        span_s=span_s or facts.span_s,
    )  # fmt: skip
    return RawSource(about, frames(log), lens, rate_hz=rate_hz, close=close)


def _facts_of_lens(name: str, lens: Intrinsics, stated_by: str) -> SourceFacts:
    """Return what is known of a camera whose images were not looked at; their sizes are compared later."""
    camera = CameraFacts(stated_by=stated_by, lens=lens)
    return SourceFacts(name=name, cameras=(camera,))


def source_of_frames(
    name: str,
    frames: Iterable[Frame],
    camera: Camera,
    *,
    has_depth: bool,
    has_stereo: bool = False,
    close: Callable[[], None] | None = None,
    notes: tuple[str, ...] = (),
    log: DoubtLog | None = None,
    span_s: tuple[float, float] | None = None,
) -> FrameStream:
    """Return frames that are undistorted and registered already as a source; *close* releases their file.

    *notes*, *log* and *span_s* are those of `SourceInfo`.
    """
    blank = no_depth(camera)

    def make(item: tuple[float, Frame]) -> Frame:
        return item[1] if has_depth else replace(item[1], depth_m=blank)

    about = SourceInfo(
        name=name, camera=camera, has_depth=has_depth, has_stereo=has_stereo, notes=notes,
        log=DoubtLog() if log is None else log, span_s=span_s,
    )  # fmt: skip
    return FrameStream(about, ((frame.timestamp_s, frame) for frame in frames), make, close=close)


def is_recording(path: Path) -> bool:
    """Say whether a path is a recording that lists its images, or a labelled file."""
    is_raw = any(path.glob("d-*.pgm"))
    return path.suffix == ".mat" or is_listed(path) or is_raw or is_euroc(path) or is_kitti(path)


def _stereo_video(
    word: str, rig: Rig, rate_hz: float | None, camera: CameraChoice | None, stated_by: str
) -> FrameStream:
    """Return two devices or videos, or one whose images show both cameras side by side."""
    if word.count(",") == 1:
        names = (word.split(",")[0], word.split(",")[1])
        both = open_pair_videos(*names)
        facts = replace(both.facts(names), cameras=_facts_of_lens(word, rig.left.lens, stated_by).cameras)
        return _pair(facts, both.pairs, rig, rate_hz, camera, both.close, both.left.span_s)
    video = open_video(word)
    facts = replace(_facts_of_lens(word, rig.left.lens, stated_by), assumed=video.notes)
    pairs = split_pairs(video.images, word)
    return _pair(facts, lambda log: pairs, rig, rate_hz, camera, video.close, video.span_s)


def _pair(
    facts: SourceFacts,
    pairs: Callable[[DoubtLog], Iterator[RawPair]],
    rig: Rig,
    rate_hz: float | None,
    camera: CameraChoice | None,
    close: Callable[[], None] | None = None,
    span_s: tuple[float, float] | None = None,
) -> FrameStream:
    """Return the frames of a pair that has passed the gate, or those of its left camera."""
    if camera == "left":
        return _single(
            replace(facts, videos={}), lambda log: ((stamp, left, None) for stamp, left, _ in pairs(log)),
            rig.left.lens, rate_hz, False, close, span_s,
        )  # fmt: skip
    right = rig.left if rig.right is None else rig.right
    of_right = _facts_of_lens(facts.name, right.lens, f"the right camera of {facts.name}").cameras
    log = DoubtLog(check_source(replace(facts, cameras=(*facts.cameras, *of_right))))
    about = SourceInfo(
        name=facts.name, camera=rig.left.lens.camera, has_stereo=True, notes=facts.assumed, log=log,
        span_s=span_s or facts.span_s,
    )  # fmt: skip
    return StereoSource(about, pairs(log), rig, rate_hz=rate_hz, close=close)


def _without_depth(raw: Iterator[RawFrame], has_depth: bool) -> Iterator[RawFrame]:
    return raw if has_depth else ((stamp, rgb, None) for stamp, rgb, _ in raw)
