"""Open a source of frames by its name: a device, a video, a folder, a recording, or a RealSense camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from client_sdk.bag_paths import BAG_ENDINGS
from client_sdk.cameras.folder import list_folder, list_pairs, pair_folders
from client_sdk.cameras.opencv_video import open_video
from client_sdk.cameras.pairs import open_pair_videos, split_pairs
from client_sdk.cameras.realsense import open_realsense
from client_sdk.cameras.source import (
    FrameSource,
    RawFrame,
    RawPair,
    checked_pairs,
    make_empty_depth,
    rectified,
    select_in_time,
    undistorted,
)
from client_sdk.datasets import CameraChoice, Dataset, open_dataset
from client_sdk.datasets.recordings import is_listed
from client_sdk.datasets.rig_recordings import is_euroc, is_kitti
from client_sdk.datasets.thinning import Thinning
from client_sdk.rigs.folder_camera import OWN_FILE, find_folder_camera
from client_sdk.rigs.intrinsics import Intrinsics, calibration_hint
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import read_calibration, read_rig
from client_sdk.source_facts import CameraFacts, DoubtLog, SourceFacts, check_source
from rse_pf.errors import UsageError
from rse_pf.storage.files import check_exists

__all__ = ["is_device", "is_recording", "open_camera", "source_of_recording"]

_REALSENSE = "realsense"  # name of a source that is a device, and not a file
_SOURCE_HINT = "name a device by its number, a video, a folder or a recording that exists"


def is_device(source: str) -> bool:
    """Return whether *source* names a device: a number or ``realsense``, and no file or folder there."""
    return (source.isdigit() or source == _REALSENSE) and not Path(source).exists()


def open_camera(
    source: Path | str | int,
    *,
    intrinsics: Intrinsics | Rig | Path | str | None = None,
    rate_hz: float | None = None,
    depth: bool = True,
    camera: CameraChoice | None = None,
    imu: bool | None = None,
) -> FrameSource:
    """Open a source, and return its undistorted frames as an iterator to be closed, or used in ``with``.

    The intrinsics that each kind of source accepts:

    ========================================  =====================  =============================
    source                                    *intrinsics*           None means
    ========================================  =====================  =============================
    device ``0``, video, ``rtsp://...``       one camera             an error
    device or video with images side by side  a rig of two cameras   an error
    two devices ``0,2`` or videos ``L,R``     a rig of two cameras   an error
    folder of images                          one camera             the file in the folder
    folder with ``left/`` and ``right/``      a rig of two cameras   ``rig.json`` in the folder
    ``realsense``                             one camera             those that the camera states
    recording of `open_dataset`, not a bag    a file, not an object  those of the recording
    ========================================  =====================  =============================

    Args:
        source: Number, path, address or word of the first column.
        intrinsics: Intrinsics or rig of the second column, or a file of them (``intrinsics.json``,
            ``rig.json``).
        rate_hz: Frames per second to deliver on average, see `client_sdk.datasets.thinning`; None means all.
        depth: Whether depth is read if the source has depth.
        camera: ``left`` uses only the left camera of a stereo pair, ``stereo`` refuses a source that is no
            stereo pair; None uses both cameras if there are two.
        imu: Whether frames have samples of an IMU, which only recordings can give; with True, a source that
            is no recording, or a recording without an IMU, is refused; None means yes if a recording has one.

    Raises:
        UsageError: There is no such source, its intrinsics are missing or of the wrong kind, it is not what
            *camera* or *imu* requires, or facts about it contradict each other.
        MissingExtra: A package for this kind of source is not installed.
    """
    # 1. Check that the source exists, and read the intrinsics that the user names.
    word = str(source)
    path = Path(word)
    for name in (word,) if path.exists() or word.count(",") != 1 else word.split(","):
        if not is_device(name) and "://" not in name:
            check_exists(name, _SOURCE_HINT)
    own = read_calibration(intrinsics) if isinstance(intrinsics, Path | str) else intrinsics
    stated_by = str(intrinsics) if isinstance(intrinsics, Path | str) else f"the intrinsics of {word}"
    if imu and not is_recording(path):
        raise UsageError(
            f"{word} is no recording, and only recordings can give samples of an IMU",
            hint="leave out imu=True, or --imu",
        )
    # 2. Open two folders of a stereo pair, or a RealSense camera.
    if pair_folders(path) is not None:
        if own is not None and not (isinstance(own, Rig) and own.right is not None):
            raise UsageError(
                f"{word} is a stereo pair, and {stated_by} is of one camera",
                hint="name a rig.json of both cameras, or leave it out to use the rig of the source",
            )
        if own is None and not (path / "rig.json").exists():
            raise UsageError(
                f"there is no {path / 'rig.json'}, and the rig is not known",
                hint="calibrate with a board that both cameras see: rse-pf camera calibrate --stereo SOURCE "
                f"--board 9x6 --square-mm 25 --out {path / 'rig.json'}",
            )
        rig = own if isinstance(own, Rig) else read_rig(path / "rig.json")
        images = list_pairs(path, rig.left.lens.rate_hz)
        facts = images.facts(rig.left.lens, str(intrinsics or path / "rig.json"), has_depth=False)
        return _open_pair(facts, images.pairs, rig, rate_hz, camera)
    if isinstance(own, Rig) and own.right is None:
        own = own.left.lens
    if word == _REALSENSE and is_device(word):
        if camera == "stereo" or isinstance(own, Rig):
            raise UsageError(
                f"{word} is one camera with depth", hint="give intrinsics of one camera, or none"
            )
        raw, factory_lens, close = open_realsense()
        lens = own if isinstance(own, Intrinsics) else factory_lens
        facts = _facts_of_lens(word, lens, stated_by)
        frames = raw if depth else ((stamp_s, rgb, None) for stamp_s, rgb, _ in raw)
        return _open_single(facts, lambda log: frames, lens, rate_hz, depth, close)
    # 3. Open a recording of a benchmark; refuse a bag, which another command reads.
    if path.suffix in BAG_ENDINGS or (path / "metadata.yaml").is_file():
        raise UsageError(
            f"{word} is a bag",
            hint="read it with rse-pf map from-bag (extra bags)",
        )
    if is_recording(path):
        if intrinsics is not None and not isinstance(intrinsics, Path | str):
            raise UsageError(f"{path} is a recording", hint="name a file of intrinsics, or leave it out")
        dataset = open_dataset(path, camera=camera, imu=imu, intrinsics=intrinsics)
        dataset.check()
        dataset = dataset if rate_hz is None else dataset.thinned(rate_hz)
        return source_of_recording(word, dataset, depth=depth)
    # 4. With a rig of two cameras, refuse a folder, which has no two folders of images; open devices or
    #    videos.
    if isinstance(own, Rig) and path.is_dir():
        raise UsageError(
            f"{word} has no two folders of images, such as left/ and right/ or image_left/ and image_right/",
            hint="give the intrinsics of one camera, or name the folder above both",
        )
    if isinstance(own, Rig):
        return _open_stereo_video(word, own, rate_hz, camera, stated_by)
    # 5. Refuse a single camera where a pair is required, else open it: a folder, a video or a device.
    if camera == "stereo":
        raise UsageError(
            f"{word} is one camera, and a stereo pair was asked for", hint="name a rig: --intrinsics rig.json"
        )
    if path.is_dir():
        if own is None:
            images = list_folder(path)
            found = find_folder_camera(path, lambda: images.size_px)
            if found is None:
                raise UsageError(
                    f"there is no {path / OWN_FILE}, and the intrinsics are not known",
                    hint=calibration_hint(word, path / OWN_FILE),
                )
            stated_by, own = str(found[0]), found[1]
        return _open_folder(path, own, stated_by, rate_hz, depth)
    if word.count(",") == 1 and not path.exists():
        raise UsageError(
            f"{word} names two cameras, and no rig",
            hint=f"rse-pf camera calibrate --stereo {word.replace(',', ' ')}; then --intrinsics rig.json",
        )
    if own is None:
        raise UsageError(
            f"the intrinsics of {word} are not known", hint=calibration_hint(word, "intrinsics.json")
        )
    facts = _facts_of_lens(word, own, stated_by)
    check_source(facts)  # wrong intrinsics are refused before a device is opened
    video = open_video(word)
    facts = replace(facts, assumed=video.notes)
    return _open_single(facts, lambda log: video.images, own, rate_hz, False, video.close, video.span_s)


def _open_folder(
    path: Path, lens: Intrinsics, stated_by: str, rate_hz: float | None, use_depth: bool
) -> FrameSource:
    """Return the frames of a folder of images, with depth if the folder has some and *use_depth* is set.

    *stated_by* names the file of *lens* in messages.  The frames are thinned to *rate_hz*; None yields all.
    """
    images = list_folder(path, lens.rate_hz)
    has_depth = use_depth and images.partners is not None
    facts = images.facts(lens, stated_by, has_depth=has_depth)

    def frames(log: DoubtLog) -> Iterator[RawFrame]:
        return images.frames(log, lens.depth_units_per_m if has_depth else None)

    return _open_single(facts, frames, lens, rate_hz, has_depth)


def _open_single(
    facts: SourceFacts,
    frames: Callable[[DoubtLog], Iterator[RawFrame]],
    lens: Intrinsics,
    rate_hz: float | None,
    has_depth: bool,
    close: Callable[[], None] | None = None,
    span_s: tuple[float, float] | None = None,
) -> FrameSource:
    """Check the facts of a source that has one camera, and return its undistorted frames.

    Only *facts* are checked.  A frame that is not later than the frame before is left out.

    Args:
        facts: What is known of the source before its first image is read.
        frames: Yields the images, not yet undistorted; called once, with the log that takes later doubts.
        lens: Intrinsics by which the images are undistorted.
        rate_hz: Frames per second to which the frames are thinned; None yields all.
        has_depth: Whether the frames have depth, as the `FrameSource` will state.
        close: Closes the device or the file; called when the `FrameSource` is closed, or if facts
            contradict each other.
        span_s: First and last time stamp of the frames, s; None takes the span of *facts*.

    Raises:
        UsageError: Two of the facts contradict each other.
    """
    log = _check(facts, close)
    thinning = None if rate_hz is None else Thinning(rate_hz)
    in_time = select_in_time(frames(log), facts.name, log, thinning)
    return FrameSource(
        name=facts.name,
        camera=lens.camera,
        frames=undistorted(in_time, lens, facts.name),
        has_depth=has_depth,
        notes=facts.assumed,
        log=log,
        span_s=span_s or facts.span_s,
        release=close,
    )


def _check(facts: SourceFacts, close: Callable[[], None] | None) -> DoubtLog:
    """Return the doubts about a source; call *close* if its facts contradict each other.

    Raises:
        UsageError: Two facts contradict each other.
    """
    try:
        return DoubtLog(check_source(facts))
    except UsageError:
        if close is not None:
            close()
        raise


def _facts_of_lens(name: str, lens: Intrinsics, stated_by: str) -> SourceFacts:
    """Return the facts of a camera before any image is read; `undistorted` checks the size of images."""
    camera = CameraFacts(stated_by=stated_by, lens=lens)
    return SourceFacts(name=name, cameras=(camera,))


def source_of_recording(name: str, recording: Dataset, *, depth: bool = True) -> FrameSource:
    """Return the frames of a recording as a source, which closes the recording.

    *name* is the recording in messages.  If *depth* is False, the depth image of each frame is replaced by an
    empty one.  A frame that is not later than the frame before is left out.
    """
    has_depth = depth and recording.has_depth
    empty_depth = make_empty_depth(recording.camera)
    in_time = select_in_time(((frame.timestamp_s, frame) for frame in recording), name, recording.log)
    return FrameSource(
        name=name,
        camera=recording.camera,
        frames=(frame if has_depth else replace(frame, depth_m=empty_depth) for _, frame in in_time),
        has_depth=has_depth,
        has_stereo=recording.has_stereo,
        notes=recording.notes,
        log=recording.log,
        span_s=recording.span_s,
        release=recording.close,
        recording=recording,
    )


def is_recording(path: Path) -> bool:
    """Return whether a path is a recording that `open_camera` opens with `open_dataset`.

    These are folders in the layout of TUM, EuRoC or KITTI, raw folders of NYU Depth V2, and files whose name
    ends in ``.mat``; ROS bags are not.
    """
    is_raw = any(path.glob("d-*.pgm"))
    return path.suffix == ".mat" or is_listed(path) or is_raw or is_euroc(path) or is_kitti(path)


def _open_stereo_video(
    word: str, rig: Rig, rate_hz: float | None, camera: CameraChoice | None, stated_by: str
) -> FrameSource:
    """Return the frames of two devices or videos (``LEFT,RIGHT``), or of one with both images side by side.

    *camera* and *rate_hz* are those of `_open_pair`, and *stated_by* names the file of *rig* in messages.
    """
    if word.count(",") == 1:
        names = (word.split(",")[0], word.split(",")[1])
        both = open_pair_videos(*names)
        facts = replace(both.facts(names), cameras=_facts_of_lens(word, rig.left.lens, stated_by).cameras)
        return _open_pair(facts, both.pairs, rig, rate_hz, camera, both.close, both.left.span_s)
    video = open_video(word)
    facts = replace(_facts_of_lens(word, rig.left.lens, stated_by), assumed=video.notes)
    pairs = split_pairs(video.images, word)
    return _open_pair(facts, lambda log: pairs, rig, rate_hz, camera, video.close, video.span_s)


def _open_pair(
    facts: SourceFacts,
    pairs: Callable[[DoubtLog], Iterator[RawPair]],
    rig: Rig,
    rate_hz: float | None,
    camera: CameraChoice | None,
    close: Callable[[], None] | None = None,
    span_s: tuple[float, float] | None = None,
) -> FrameSource:
    """Check the facts of a stereo pair, and return its rectified frames, thinned to *rate_hz* (None: all).

    If *camera* is ``left``, they are those of the left camera alone, undistorted and not rectified.  *close*
    releases the devices or videos; it is called when the `FrameSource` is closed, or if facts contradict each
    other.

    Raises:
        UsageError: Two facts contradict each other, or *rig* has one camera.
    """
    if camera == "left":
        return _open_single(
            replace(facts, videos={}),
            lambda log: ((stamp_s, left, None) for stamp_s, left, _ in pairs(log)),
            rig.left.lens,
            rate_hz,
            False,
            close,
            span_s,
        )
    if rig.right is None:
        raise UsageError(f"the rig of {facts.name} has one camera", hint="calibrate both: --stereo")
    right_facts = _facts_of_lens(facts.name, rig.right.lens, f"the right camera of {facts.name}").cameras
    log = _check(replace(facts, cameras=(*facts.cameras, *right_facts)), close)
    rectification = Rectification(rig.left, rig.right)
    thinning = None if rate_hz is None else Thinning(rate_hz)
    in_time = select_in_time(pairs(log), facts.name, log, thinning)
    return FrameSource(
        name=facts.name,
        camera=rectification.camera,
        frames=checked_pairs(rectified(in_time, rectification), facts.name),
        has_stereo=True,
        notes=facts.assumed,
        log=log,
        span_s=span_s or facts.span_s,
        release=close,
    )
