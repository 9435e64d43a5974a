"""Open a ROS bag as frames, with undistorted or rectified images and registered depth, in the order of time.

The bag is read twice: once for its time stamps, transforms and broken messages, and once for the images, of
which few are in memory at a time.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BagFile, BrokenMessage, RawMessage, Topic, open_bag_file
from client_sdk.bags.choose import (
    ChosenTopics,
    choose_topics,
    is_rectified,
    is_registered,
    topics_line,
)
from client_sdk.bags.images import ImageFormat, decode_colour, decode_depth, format_of
from client_sdk.bags.imu import ImuMount, imu_track
from client_sdk.bags.index import (
    BagIndex,
    CameraTimes,
    ImageStamps,
    read_index,
)
from client_sdk.bags.lens import lens_of
from client_sdk.bags.lens_change import mismatch_px
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE
from client_sdk.bags.realsense_recording import stated_depth_unit_m, stated_T_colour_depth
from client_sdk.bags.registration import register_depth
from client_sdk.bags.stereo import pair_of
from client_sdk.bags.stream import ImageStream
from client_sdk.datasets.dataset import Dataset
from client_sdk.frontend import Frame, load_opencv
from client_sdk.image_map import ImageMap, map_to_pinhole
from client_sdk.rigs.imu_track import ImuTrack
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera
from client_sdk.source_facts import (
    CameraFacts,
    DepthFacts,
    Doubt,
    DoubtLog,
    DoubtName,
    LossFacts,
    SourceFacts,
    TimeFacts,
    check_source,
    median_depth_m,
)
from client_sdk.stamp_pairs import nearest_gap_s, pair_stamps
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, Lens, inverse

__all__ = ["Bag", "BagOptions", "open_bag"]

_USUAL_DEPTH_SCALE = 1000.0  # units per metre of 16-bit depth if nothing is stated: millimetres (REP 118)
# Largest difference of focal lengths and principal points, as a share of the image's size, of two cameras
# with the same view.
_MAX_VIEW_DIFFERENCE = 0.01
# Largest number of changes of the calibration in ``CameraInfo`` that are compared with the images before and
# after them; an autofocus causes many.
_MAX_CHECKED_CHANGES = 5
# The images before and after a change of the calibration in ``CameraInfo`` contradict the change if their
# error (`mismatch_px`) with the change exceeds that without it by more than this, px, and by more than the
# factor `_MIN_MISMATCH_RATIO`; the bag is then refused.
_MIN_MISMATCH_PX = 3.0
# Ratio of the error with the change of the calibration to that without it above which images contradict the
# change, if `_MIN_MISMATCH_PX` is exceeded as well.
_MIN_MISMATCH_RATIO = 2.0
_ESTIMATED_FRAMES = {"odom", "map"}
"""Root frames of tf whose poses come from an odometry or another SLAM system, and are no ground truth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BagOptions:
    """Options of reading a bag; a topic that is None is chosen by its type and name.

    Attributes:
        colour: Topic of the colour images, or of the left camera of a stereo pair.
        depth: Topic of the depth images.
        right: Topic of the right camera of a stereo pair.
        info: ``CameraInfo`` topic of the colour images.
        truth: Topic of true poses: PoseStamped, PoseWithCovarianceStamped or Odometry.
        imu: Topic of the IMU.
        lens: Lens of the colour camera that replaces the one in the bag.
        rig: Rig of one camera or of a stereo pair, and the IMU, that replaces those in the bag.
        depth_scale: Units of depth per metre.  None uses the unit that the bag states, or otherwise 1000 for
            16-bit depth and 1 for floats.
        pair_within_s: Largest difference of the time stamps, seconds, of the colour and the depth image of a
            frame, or of its left and right image.
        use_depth: False uses neither depth images nor a stereo pair, unless *right* or *use_stereo* asks for
            a pair.
        use_stereo: True uses a stereo pair even if the bag has depth images; False uses only the left camera
            of a pair; None uses a pair if the bag has no depth images.
        use_imu: True uses the IMU, and refuses a bag without a usable IMU; False leaves the IMU out; None
            uses a usable IMU.

    Raises:
        UsageError: *depth_scale* or *pair_within_s* is not above 0.
    """

    colour: str | None = None
    depth: str | None = None
    right: str | None = None
    info: str | None = None
    truth: str | None = None
    imu: str | None = None
    lens: Lens | None = None
    rig: Rig | None = None
    depth_scale: float | None = None
    pair_within_s: float = 0.02
    use_depth: bool = True
    use_stereo: bool | None = None
    use_imu: bool | None = None

    def __post_init__(self) -> None:
        for name, value in (("depth_scale", self.depth_scale), ("pair_within_s", self.pair_within_s)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(
                    f"{name} = {value:g} is not a finite number above 0", hint="leave it out for the default"
                )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bag(Dataset):
    """The recording of an open bag, to be closed, or used in ``with``.

    `read` raises UsageError if an image cannot be decoded, and reads ascending rows without seeking.

    Attributes:
        topics: The topics that are used: ``colour`` (the left one of a stereo pair), ``right``, ``depth`` and
            ``imu``, as far as there are any.
    """

    topics: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _BagReader:
    """Read the frames of an open bag, without the samples of its IMU."""

    name: str
    camera: Camera
    timestamps_s: tuple[float, ...]
    has_depth: bool
    file: BagFile
    stream: ImageStream
    pairs: tuple[_Pair, ...]
    colour_rectifier: _TopicRectifier
    depth_rectifier: _TopicRectifier
    depth_scale: float
    is_float_depth: bool
    registration: tuple[Camera, Array] | None
    rectification: Rectification | None
    no_depth: npt.NDArray[np.float32]

    def read(self, row: int) -> Frame:
        """Return the frame with the index *row*; raises UsageError if the image cannot be decoded."""
        pair = self.pairs[row]
        raw = self.stream.take(pair)
        try:
            colours = decode_colour(self.file.parse(raw[0]))
            if self.rectification is not None:
                return self._stereo_frame(row, self.rectification, colours, raw[1])
            rgb = self.colour_rectifier.of(pair[0]).colour(colours)
            depth_m = self._depth_of(pair, raw)
        except BrokenMessage as error:
            raise UsageError(
                f"{self.name} at {self.timestamps_s[row]:.6f} s: {error}", hint="record the bag again"
            ) from error
        return Frame(timestamp_s=self.timestamps_s[row], rgb=rgb, depth_m=depth_m, camera=self.camera)

    def _stereo_frame(
        self, row: int, rectify: Rectification, colours: npt.NDArray[np.uint8], raw: RawMessage
    ) -> Frame:
        cv2 = load_opencv()
        gray = cv2.cvtColor(decode_colour(self.file.parse(raw)), cv2.COLOR_RGB2GRAY)
        return Frame(
            timestamp_s=self.timestamps_s[row],
            rgb=rectify.left(colours),
            depth_m=self.no_depth,
            camera=self.camera,
            stereo=rectify.right(gray),
            T_body_camera=rectify.T_body_camera,
        )

    def _depth_of(self, pair: _Pair, raw: list[RawMessage]) -> npt.NDArray[np.float32]:
        if not self.has_depth:
            return self.no_depth
        message = self.file.parse(raw[1])
        if self.is_float_depth:
            depth_m = decode_depth(message, 1.0) / np.float32(self.depth_scale)
        else:
            depth_m = decode_depth(message, self.depth_scale)
        depth_m = self.depth_rectifier.of(pair[1]).depth(depth_m)
        if self.registration is None:
            return depth_m
        return register_depth(depth_m, *self.registration, self.camera)

    def close(self) -> None:
        """Close the file; no frame can be read any more."""
        self.stream.close()
        self.file.close()


def open_bag(path: Path | str, options: BagOptions | None = None) -> Bag:
    """Open a ROS 1 bag, or a ROS 2 bag in sqlite3 or MCAP; images are read later.

    The bag is read once for its time stamps, which takes a while for a large bag.

    Raises:
        UsageError: The bag cannot be read, a topic or calibration is missing or cannot be used, or facts
            contradict each other.
        MissingExtra: ``rosbags`` or OpenCV is not installed.
    """
    options = options or BagOptions()
    file = open_bag_file(Path(path))
    try:
        return _open(file, options)
    except BaseException:
        file.close()
        raise


def _open(file: BagFile, options: BagOptions) -> Bag:
    name = file.path.name
    formats, infos = _first_messages(file)
    chosen = choose_topics(
        file.topics,
        formats,
        infos,
        colour=options.colour,
        depth=options.depth,
        right=options.right,
        info=options.info,
        poses=options.truth,
        use_depth=options.use_depth,
        imu=options.imu,
        use_stereo=options.use_stereo,
        use_imu=options.use_imu is not False,
    )
    index = read_index(file, chosen, formats)
    lenses, times = _lenses_of_colour(file, chosen, index, options, formats)
    rectification, T_left_camera = _rectification(file, chosen, formats, index, options)
    lens = _usual_lens(lenses, times, index.colour)
    camera = lens.camera if rectification is None else rectification.camera
    pairs, stamps_ns = _pair_images(name, index, chosen, options)
    depth_rectifier, registration, doubts = _prepare_depth(file, chosen, formats, lenses, lens, times, index)
    truth, truth_kind, truth_note = _truth(chosen, formats, index, stamps_ns)
    if truth is not None:
        truth = Trajectory(truth.timestamps_s, truth.T_world_camera @ T_left_camera)
    imu, imu_notes = _imu(chosen, formats, index, np.array(stamps_ns) / 1e9, T_left_camera, options)
    no_depth = np.zeros((camera.height, camera.width), dtype=np.float32)
    no_depth.flags.writeable = False
    unit_m = None if chosen.depth is None else stated_depth_unit_m(file, chosen.depth.name)
    is_float = chosen.depth is not None and formats[chosen.depth.name].encoding.startswith("32FC1")
    usual = 1.0 if is_float else _USUAL_DEPTH_SCALE
    depth_scale = options.depth_scale or (usual if unit_m is None else 1.0 / unit_m)
    stream = ImageStream(file, list({pair[0] for pair in pairs[0]}), use_log_time=index.uses_log_time)
    reader = _BagReader(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamp / 1e9 for stamp in stamps_ns),
        has_depth=chosen.depth is not None,
        file=file,
        stream=stream,
        pairs=tuple(pairs),
        colour_rectifier=_TopicRectifier(times, [map_to_pinhole(each, lens.camera) for each in lenses]),
        depth_rectifier=depth_rectifier,
        depth_scale=depth_scale,
        is_float_depth=is_float,
        registration=registration,
        rectification=rectification,
        no_depth=no_depth,
    )
    facts = SourceFacts(
        name=name,
        cameras=[CameraFacts(stated_by=_stated_by(chosen, options), lens=each) for each in lenses],
        depth=_depth_facts(
            reader, is_unit_stated=is_float or unit_m is not None or options.depth_scale is not None
        ),
        times=[TimeFacts(stated_by=chosen.colour.name, stamps_s=np.array(reader.timestamps_s))],
        losses=tuple(_loss_facts(index, pairs, chosen, options)),
        doubts=(*doubts, *_change_doubts(chosen, lenses, lens)),
    )
    _check_changes(reader, chosen, lenses, times)
    used = {"colour": chosen.colour, "right": chosen.right, "depth": chosen.depth,
            "imu": None if imu is None else chosen.imu}  # fmt: skip
    return Bag(
        name=name,
        camera=camera,
        timestamps_s=reader.timestamps_s,
        truth=truth,
        truth_kind=truth_kind,
        rows=tuple(range(len(pairs))),
        read=reader.read,
        notes=(
            *_notes(chosen, formats, lens, options),
            *_pair_note(rectification),
            *imu_notes,
            *_unit_note(unit_m, options, depth_scale, None if is_float else chosen.depth),
            *_registration_note(chosen, registration),
            truth_note,
            *_order_notes(index),
            *facts.notes,
        ),
        has_depth=reader.has_depth,
        has_stereo=rectification is not None,
        has_camera_truth=False,
        imu=imu,
        log=DoubtLog(check_source(facts)),
        release=reader.close,
        topics={name: topic.name for name, topic in used.items() if topic is not None},
    )


_Pair = tuple[tuple[str, int, int], ...]
"""The one or two images of a frame.  Of each image: its topic, the stamp of the message, and the time of
writing, both in nanoseconds."""


@dataclass(frozen=True, slots=True, eq=False)
class _TopicRectifier:
    """The undistortion of the images of a topic, whose lens may change during the drive.

    ``rectifiers`` has one map to pixels of the pinhole camera for each message of ``times``.
    """

    times: CameraTimes
    rectifiers: Sequence[ImageMap]

    def of(self, image: tuple[str, int, int]) -> ImageMap:
        """Return the pixel map that undistorts an image: its topic, stamp (ns) and time of writing (ns)."""
        _, stamp_ns, log_ns = image
        return self.rectifiers[self.times.row_at(stamp_ns, log_ns) if len(self.rectifiers) > 1 else 0]


def _depth_facts(reader: _BagReader, *, is_unit_stated: bool) -> DepthFacts | None:
    """Return the median depth of the first, middle and last frame with its unit; None without depth."""
    if not reader.has_depth:
        return None
    rows = sorted({round(share * (len(reader.pairs) - 1)) for share in (0.0, 0.5, 1.0)})
    depths_m = []
    for row in rows:
        with contextlib.suppress(UsageError):  # an image that cannot be decoded is reported when it is used
            depths_m.append(reader.read(row).depth_m)
    return DepthFacts(
        median_m=median_depth_m(depths_m), units_per_m=reader.depth_scale, is_unit_stated=is_unit_stated
    )


def _stated_by(chosen: ChosenTopics, options: BagOptions) -> str:
    if options.lens is None and options.rig is None and chosen.colour_info:
        return chosen.colour_info.name
    return "the file of intrinsics"


def _change_doubts(chosen: ChosenTopics, lenses: Sequence[Lens], lens: Lens) -> tuple[Doubt, ...]:
    """Return a doubt if the bag states several calibrations of the colour camera; otherwise empty.

    *lenses* are these calibrations, and *lens* is the one to whose camera all images are resampled.
    """
    if len(lenses) < 2 or chosen.colour_info is None:
        return ()
    focal = ", ".join(f"{each.camera.fx:g}" for each in lenses)
    sentence = (
        f"{chosen.colour_info.name} states {len(lenses)} cameras in the drive, with fx {focal}; images of "
        f"each are resampled to fx {lens.camera.fx:g}"
    )
    hint = "give one calibration with --intrinsics, if the lens was not moved"
    return (Doubt(name=DoubtName.CAMERA_CHANGES, sentence=sentence, hint=hint),)


def _check_changes(
    reader: _BagReader, chosen: ChosenTopics, lenses: Sequence[Lens], times: CameraTimes
) -> None:
    """Compare the images before and after the first five changes of the calibration in ``CameraInfo``.

    Raises:
        UsageError: The images show that the lens did not change: one of the two calibrations is wrong.
    """
    if len(lenses) < 2:
        return
    valid = [times.row_at(stamp_ns, log_ns) for (_, stamp_ns, log_ns), *_ in reader.pairs]
    changes = [row for row in range(1, len(valid)) if valid[row] != valid[row - 1]]
    for row in changes[:_MAX_CHECKED_CHANGES]:
        lens, other = lenses[valid[row - 1]], lenses[valid[row]]
        try:
            images = [decode_colour(reader.file.parse(reader.stream.take(reader.pairs[each])[0]))
                      for each in (row - 1, row)]  # fmt: skip
        except BrokenMessage:
            continue
        mismatches_px = mismatch_px(images[0], images[1], lens, other)
        if mismatches_px is None:
            continue
        changed_px, unchanged_px = mismatches_px
        if changed_px > max(_MIN_MISMATCH_RATIO * unchanged_px, unchanged_px + _MIN_MISMATCH_PX):
            topic = _stated_by(chosen, BagOptions())
            raise UsageError(
                f"{topic} states fx {lens.camera.fx:g} before {reader.timestamps_s[row]:.3f} s and "
                f"fx {other.camera.fx:g} from then on, but the lens did not change: the images before and "
                f"after miss by {changed_px:.0f} px with both cameras, and by {unchanged_px:.0f} px with one",
                hint="give the calibration that is right: --intrinsics intrinsics.json",
            )


def _unit_note(
    unit_m: float | None, options: BagOptions, depth_scale: float, depth: Topic | None
) -> tuple[str, ...]:
    """Return a sentence on the unit of depth if the bag states a unit or if a unit is assumed, else no text.

    *unit_m* is the stated unit in metres, or None.  *depth* is the topic of 16-bit depth; None for floats,
    which are metres by REP 118.
    """
    if unit_m is not None:
        used = "" if options.depth_scale is None else f", but depth_scale {depth_scale:g} is used"
        return (f"the recorder states depth in units of {1000.0 * unit_m:g} mm{used}",)
    if depth is None or options.depth_scale is not None:
        return ()
    return (f"nothing states the unit of {depth.name}: {depth_scale:g} units a metre are assumed (REP 118)",)


def _registration_note(chosen: ChosenTopics, registration: tuple[Camera, Array] | None) -> tuple[str, ...]:
    if registration is None or chosen.depth is None:
        return ()
    apart_mm = 1000.0 * float(np.linalg.norm(registration[1][:3, 3]))
    return (f"{chosen.depth.name} is moved to {chosen.colour.name} over {apart_mm:.1f} mm, pixel by pixel",)


def _first_messages(file: BagFile) -> tuple[dict[str, ImageFormat], dict[str, str]]:
    """Return the formats of all image topics, and the frames of all ``CameraInfo`` topics, by name."""
    formats: dict[str, ImageFormat] = {}
    infos: dict[str, str] = {}
    for topic in file.topics:
        if topic.kind not in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO) or not topic.messages:
            continue
        for raw in _first_raw_messages(file, topic.name):
            try:
                message = file.parse(raw)
                if topic.kind == CAMERA_INFO:
                    infos[topic.name] = str(message.header.frame_id)
                else:
                    formats[topic.name] = format_of(message, topic.kind)
            except BrokenMessage:
                continue
            break
    return formats, infos


def _first_raw_messages(file: BagFile, topic: str) -> Iterator[RawMessage]:
    """Yield the first ten messages of a topic, among which a valid one is searched."""
    try:
        for number, raw in enumerate(file.messages([topic])):
            if number >= 10:
                return
            yield raw
    except BrokenMessage:
        return


def _lenses_of_colour(
    file: BagFile, chosen: ChosenTopics, index: BagIndex, options: BagOptions, formats: dict[str, ImageFormat]
) -> tuple[list[Lens], CameraTimes]:
    """Return the different lenses of the colour camera, usually one, and when each of them is valid."""
    info = chosen.colour_info
    if options.lens is not None or options.rig is not None:
        lens = options.lens if options.rig is None else options.rig.left.lens
        assert lens is not None
        _check_size(chosen.colour.name, formats, "the file of intrinsics", lens.camera)
        return [lens], CameraTimes()
    times = CameraTimes() if info is None else index.cameras[info.name]
    if info is None or not times.messages:
        raise UsageError(
            f"the bag has no camera_info for {chosen.colour.name}; its topics: "
            f"{topics_line(file.topics, formats)}",
            hint="name its topic with --info TOPIC, or give a file with --intrinsics",
        )
    is_flat = is_rectified(chosen.colour)
    lenses = [lens_of(message, info.name, is_rectified=is_flat) for message in times.messages]
    for lens in lenses:
        _check_size(chosen.colour.name, formats, info.name, lens.camera)
    return lenses, times


def _usual_lens(lenses: Sequence[Lens], times: CameraTimes, images: ImageStamps) -> Lens:
    """Return that of the *lenses* of a drive which is valid for most images."""
    rows = [times.row_at(int(s), int(log)) for s, log in zip(images.header_ns, images.log_ns, strict=True)]
    return lenses[Counter(rows).most_common(1)[0][0]] if rows and len(lenses) > 1 else lenses[0]


def _check_size(topic: str, formats: Mapping[str, ImageFormat], source: str, camera: Camera) -> None:
    size = formats[topic].size
    if size is not None and size != (camera.width, camera.height):
        raise UsageError(
            f"{topic} has images of {size[0]}x{size[1]} px, {source} is for "
            f"{camera.width}x{camera.height} px",
            hint="give intrinsics of that size: --intrinsics intrinsics.json",
        )


def _rectification(
    file: BagFile,
    chosen: ChosenTopics,
    formats: dict[str, ImageFormat],
    index: BagIndex,
    options: BagOptions,
) -> tuple[Rectification | None, Array]:
    """Return the rectification of a stereo pair, None for one camera, and ``T_left_camera`` ``(4, 4)``.

    ``T_left_camera`` is the pose of the camera of the frames (the rectified left one) in the left camera of
    the bag; the identity for one camera.

    Raises:
        UsageError: The calibration of a camera of the pair is missing, changes, or is for another size.
    """
    if chosen.right is None:
        return None, np.eye(4)
    if options.rig is not None:
        left, right = options.rig.left, options.rig.right
        if right is None:
            raise UsageError(
                "the rig has one camera, and a stereo pair needs two",
                hint="give a rig of two cameras, or use one: --no-depth",
            )
        _check_size(chosen.colour.name, formats, "the rig", left.lens.camera)
        _check_size(chosen.right.name, formats, "the rig", right.lens.camera)
    else:
        if options.lens is not None:
            raise UsageError(
                "the intrinsics are those of one camera, and a pair needs two",
                hint="give --intrinsics rig.json, or take one camera: --no-depth",
            )
        left, right = _pair_of_bag(file, chosen, formats, index)
    rectification = Rectification(left, right)
    return rectification, inverse(left.T_body_camera) @ rectification.T_body_camera


def _pair_of_bag(
    file: BagFile, chosen: ChosenTopics, formats: dict[str, ImageFormat], index: BagIndex
) -> tuple[RigCamera, RigCamera]:
    left, right = chosen.colour_info, chosen.right_info
    assert chosen.right is not None
    if left is None or right is None or not index.cameras[right.name].messages:
        raise UsageError(
            f"the bag has no camera_info for {chosen.right.name}; its topics: "
            f"{topics_line(file.topics, formats)}",
            hint="give both cameras with --intrinsics rig.json, or take one: --no-depth",
        )
    for info in (left, right):
        if len(index.cameras[info.name].messages) > 1:
            raise UsageError(
                f"{info.name} states {len(index.cameras[info.name].messages)} cameras in the drive, and a "
                "pair is rectified for one",
                hint="give both cameras with --intrinsics rig.json, or take one: --no-depth",
            )
    messages = [
        (info.name, index.cameras[info.name].messages[0], is_rectified(topic))
        for info, topic in ((left, chosen.colour), (right, chosen.right))
    ]
    frames = [formats[topic.name].frame for topic in (chosen.colour, chosen.right)]
    are_apart = frames[0].strip("/") != frames[1].strip("/")
    pair = pair_of(messages[0], messages[1], index.tree.between(*frames) if are_apart else None)
    _check_size(chosen.right.name, formats, right.name, pair[1].lens.camera)
    return pair


def _pair_images(
    name: str, index: BagIndex, chosen: ChosenTopics, options: BagOptions
) -> tuple[list[_Pair], list[int]]:
    """Return the images of each frame, one or two, and the time stamp of each frame, nanoseconds.

    Each colour or left image is paired with the depth or right image that is nearest in time; images without
    a partner within ``pair_within_s`` are left out.
    """
    colour, second = index.colour, index.second
    topic, partner_topic = chosen.colour.name, chosen.second
    if not len(colour.stamps_ns) or not len(second.stamps_ns):
        bad = topic if not len(colour.stamps_ns) or partner_topic is None else partner_topic.name
        reason = index.first_broken or index.ended or "it has no message"
        raise UsageError(f"{name}: no image of {bad} can be used: {reason}", hint="name another topic")
    wanted = _images_of(topic, colour)
    if partner_topic is None:
        return [(image,) for image in wanted], colour.stamps_ns.tolist()
    rows = pair_stamps(colour.stamps_ns, second.stamps_ns, round(1e9 * options.pair_within_s))
    if not rows:
        gap_s = nearest_gap_s(colour.stamps_ns, second.stamps_ns)
        raise UsageError(
            f"{name}: no image of {topic} has {_partner(chosen)} within {options.pair_within_s:g} s; "
            f"the nearest is {gap_s:.3f} s away",
            hint="widen it with --pair-within S, or check that both drivers use the same clock",
        )
    partners = _images_of(partner_topic.name, second)
    stamps_ns = [int(colour.stamps_ns[row]) for row, _ in rows]
    return [(wanted[row], partners[partner]) for row, partner in rows], stamps_ns


def _images_of(topic: str, images: ImageStamps) -> list[tuple[str, int, int]]:
    return [(topic, int(s), int(log)) for s, log in zip(images.header_ns, images.log_ns, strict=True)]


def _partner(chosen: ChosenTopics) -> str:
    return "depth" if chosen.right is None else "a right one"


def _prepare_depth(
    file: BagFile,
    chosen: ChosenTopics,
    formats: Mapping[str, ImageFormat],
    lenses: Sequence[Lens],
    lens: Lens,
    times: CameraTimes,
    index: BagIndex,
) -> tuple[_TopicRectifier, tuple[Camera, Array] | None, tuple[Doubt, ...]]:
    """Return the undistortion of depth images, the registration to the colour camera, and doubts.

    The registration is the depth camera and ``T_colour_depth``; it is None if the depth has the pixels of the
    colour image already, or if that is assumed, which is then a doubt.
    """
    camera, depth = lens.camera, chosen.depth
    if depth is None:
        return _TopicRectifier(times, [ImageMap(None)]), None, ()
    info, image, colours = chosen.depth_info, formats[depth.name], formats[chosen.colour.name]
    own_times = CameraTimes() if info is None else index.cameras[info.name]
    own = [
        lens_of(message, info.name, is_rectified=is_rectified(depth))
        for message in own_times.messages
        if info is not None
    ]
    if any(image.size not in (None, (each.camera.width, each.camera.height)) for each in own):
        own = []
    colour_rectifier = _TopicRectifier(times, [map_to_pinhole(each, camera) for each in lenses])
    T_colour_depth = stated_T_colour_depth(file, chosen.colour.name, depth.name)
    if T_colour_depth is None and is_registered(depth):
        T_colour_depth = np.eye(4)
    elif T_colour_depth is None and image.frame.strip("/") != colours.frame.strip("/"):
        T_colour_depth = index.tree.between(colours.frame, image.frame) if image.frame else None
    elif T_colour_depth is None and not any(_is_other_view(each.camera, camera) for each in own):
        T_colour_depth = np.eye(4)
    is_same_size = image.size in (None, (camera.width, camera.height))
    if T_colour_depth is not None and is_same_size and np.allclose(T_colour_depth, np.eye(4), atol=1e-6):
        own_rectifier = _TopicRectifier(own_times, [map_to_pinhole(each, camera) for each in own])
        return own_rectifier if own else colour_rectifier, None, ()
    if T_colour_depth is not None and own:
        return (
            _TopicRectifier(own_times, [map_to_pinhole(each, own[0].camera) for each in own]),
            (own[0].camera, T_colour_depth),
            (),
        )
    if not own and not is_same_size:
        raise UsageError(
            f"{depth.name} is not registered to {chosen.colour.name}, and its camera_info or the transform "
            f"from {image.frame} to {colours.frame} is missing",
            hint="record the registered (aligned) depth topic of your driver, or camera_info and /tf_static",
        )
    fx = own[0].camera.fx if own else camera.fx
    doubt = Doubt(
        name=DoubtName.DEPTH_REGISTRATION,
        sentence=f"{depth.name} (fx {fx:g}) is taken as seen from where {chosen.colour.name} "
        f"(fx {camera.fx:g}) is: nothing states the transform from {image.frame or 'its frame'} to "
        f"{colours.frame or 'the other'}",
        hint="record the registered (aligned) depth topic of your driver, or /tf_static",
    )
    if own:
        return _TopicRectifier(own_times, [map_to_pinhole(each, camera) for each in own]), None, (doubt,)
    return colour_rectifier, None, (doubt,)


def _is_other_view(one: Camera, other: Camera) -> bool:
    """Return whether two cameras have different fields of view, by intrinsics over the image's size."""

    def shares_of(camera: Camera) -> Array:
        across, down = camera.width, camera.height
        return np.array([camera.fx / across, camera.fy / down, camera.cx / across, camera.cy / down])

    return not np.allclose(shares_of(one), shares_of(other), rtol=0.0, atol=_MAX_VIEW_DIFFERENCE)


def _truth(
    chosen: ChosenTopics, formats: Mapping[str, ImageFormat], index: BagIndex, stamps_ns: list[int]
) -> tuple[Trajectory | None, Literal["ground truth", "reference", "none"], str]:
    """Return the true path of the colour or left camera, its kind, and a sentence on its source.

    The path is None without poses, or if the clock was set back.
    """
    if index.colour.clock_step_ns:
        return None, "none", "no ground truth: the clock of its stamps was set back in the drive"
    frame = formats[chosen.colour.name].frame
    root, moves = index.tree.root_of(frame)
    by_tf = index.tree.path(frame, stamps_ns) if moves else None
    is_estimate = root in _ESTIMATED_FRAMES
    if chosen.poses is not None and (by_tf is None or is_estimate):
        path = index.poses.path(stamps_ns)
        if path is not None:
            kind = "ground truth" if chosen.poses.kind == POSE else "reference"
            text = f"{kind}: {chosen.poses.name}, taken as poses of the colour camera"
            return path, "ground truth" if chosen.poses.kind == POSE else "reference", text
    if by_tf is not None:
        text = f"{'reference' if is_estimate else 'ground truth'}: tf from {root} to {frame}"
        return by_tf, "reference" if is_estimate else "ground truth", text
    return None, "none", f"no ground truth: no topic of poses, and no tf that moves {frame or 'the camera'}"


def _notes(
    chosen: ChosenTopics, formats: Mapping[str, ImageFormat], lens: Lens, options: BagOptions
) -> tuple[str, ...]:
    camera = lens.camera
    where = _stated_by(chosen, options)
    distorted = "distorted, so images are undistorted" if not lens.is_pinhole else "no distortion"
    first = "colour" if chosen.right is None else "left"
    taken = [(first, chosen.colour), ("right", chosen.right), ("depth", chosen.depth)]
    return (
        *(
            f"{what}: {topic.name}, {formats[topic.name].encoding}, {_count(topic.messages, 'message')}"
            for what, topic in taken
            if topic is not None
        ),
        f"camera: {where}, {camera.width}x{camera.height} px, fx {camera.fx:g} fy {camera.fy:g} "
        f"cx {camera.cx:g} cy {camera.cy:g}, {distorted}",
    )


def _imu(
    chosen: ChosenTopics,
    formats: Mapping[str, ImageFormat],
    index: BagIndex,
    frames_s: Array,
    T_left_camera: Array,
    options: BagOptions,
) -> tuple[ImuTrack | None, tuple[str, ...]]:
    """Return the samples of the IMU, and notes for the user.

    An IMU that cannot be used gives None and a note, or raises UsageError if the user demands or names it.
    """
    if chosen.imu is None:
        if options.use_imu:
            raise UsageError("the bag has no IMU", hint="leave out --imu")
        return None, ()
    frame, imu_frame = formats[chosen.colour.name].frame, index.imu.frame
    try:
        if index.colour.clock_step_ns:
            raise UsageError(
                "the clock of the IMU's stamps was set back in the drive", hint="cut the bag at that time"
            )
        track, note = imu_track(
            index.imu,
            chosen.imu.name,
            frames_s,
            ImuMount(
                T_left_camera=T_left_camera,
                T_left_imu=index.tree.between(frame, imu_frame) if imu_frame else None,
                rig=options.rig,
            ),
            use_log_time=index.uses_log_time,
        )
    except UsageError as error:
        if options.use_imu or options.imu is not None:
            raise
        return None, (f"the IMU is not used: {error.message}",)
    return track, (note,)


def _pair_note(rectification: Rectification | None) -> tuple[str, ...]:
    if rectification is None:
        return ()
    camera = rectification.camera
    return (
        f"stereo pair: baseline {rectification.baseline_m:.4g} m, rectified to fx {camera.fx:.6g} "
        f"cx {camera.cx:.6g} cy {camera.cy:.6g}",
    )


def _loss_facts(
    index: BagIndex, pairs: Sequence[_Pair], chosen: ChosenTopics, options: BagOptions
) -> Iterator[LossFacts]:
    """Yield the facts on messages and images that were left out, by cause."""
    images = [index.colour] if chosen.second is None else [index.colour, index.second]
    total = sum(len(each.stamps_ns) for each in images)
    if index.broken:
        sentence = f"{_count(index.broken, 'broken message')} left out; the first: {index.first_broken}"
        yield LossFacts(sentence=sentence, lost=index.broken, total=total)
    copies = sum(each.copies for each in images)
    if copies:
        sentence = f"{_count(copies, 'message')} with the time stamp of another left out"
        yield LossFacts(sentence=sentence, lost=copies, total=total)
    unstamped = sum(each.unstamped for each in images)
    if unstamped:
        sentence = f"{_count(unstamped, 'image')} with the time stamp 0 left out"
        yield LossFacts(sentence=sentence, lost=unstamped, total=total)
    if index.ended:
        sentence = f"the bag cannot be read to its end ({index.ended}); what comes before is used"
        yield LossFacts(sentence=sentence, lost=1, total=total)
    unpaired = len(index.colour.stamps_ns) - len(pairs)
    if unpaired:
        noun = "colour image" if chosen.right is None else "left image"
        yield LossFacts(
            sentence=f"{_count(unpaired, noun)} of {len(index.colour.stamps_ns)} without {_partner(chosen)} "
            f"within {options.pair_within_s:g} s left out",
            lost=unpaired, total=len(index.colour.stamps_ns), is_usual=True,
        )  # fmt: skip


def _order_notes(index: BagIndex) -> Iterator[str]:
    """Yield notes on time stamps that were corrected, sorted or replaced."""
    if index.colour.clock_step_ns:
        yield (
            f"the clock of the time stamps was set back by {index.colour.clock_step_ns / 1e9:.3f} s in the "
            "drive; the times of recording bridge it"
        )
    if not (index.colour.was_in_order and index.second.was_in_order):
        yield "the time stamps were not in order; frames are sorted by them"
    if index.uses_log_time:
        yield "a topic has no time stamp but 0; the times of recording are used"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
