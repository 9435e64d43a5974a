"""Open a ROS bag as frames: undistorted, registered, in the order of their time stamps.

The bag is read twice: once for its time stamps, transforms and broken messages, and once for the images, of
which only those that wait for their partner are in memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BagFile, BrokenMessage, RawMessage, open_bag_file
from client_sdk.bags.choose import (
    ChosenTopics,
    choose_topics,
    is_rectified,
    is_registered,
    topics_line,
)
from client_sdk.bags.images import ImageFormat, decode_colour, decode_depth, format_of
from client_sdk.bags.imu import ImuMount, imu_track
from client_sdk.bags.index import BagIndex, nearest_gap_s, pair_stamps, read_index
from client_sdk.bags.lens import Lens, Rectifier, lens_of
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POSE
from client_sdk.bags.registration import register_depth
from client_sdk.bags.stereo import pair_of
from client_sdk.bags.stream import ImageStream
from client_sdk.closing import Closing
from client_sdk.frontend import Frame, load_opencv
from client_sdk.mapping import Trajectory
from client_sdk.rigs.imu_track import ImuTrack, with_imu
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, inverse

__all__ = ["Bag", "BagOptions", "open_bag"]

_ESTIMATED_FRAMES = {"odom", "map"}
"""Roots of tf whose poses another SLAM system or an odometry estimated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BagOptions:
    """How a bag is read; a topic that is not named is found by its type.

    Attributes:
        colour: Topic of the colours; of a stereo pair, the left camera.
        depth: Topic of the depth.
        right: Topic of the right camera of a stereo pair.
        info: Topic of the camera of the colours.
        truth: Topic of true poses: PoseStamped, PoseWithCovarianceStamped or Odometry.
        imu: Topic of the IMU.
        lens: The camera, instead of that in the bag.
        rig: The cameras of a stereo pair, or the one camera, and the IMU, instead of those in the bag.
        depth_scale: Units of a 16-bit depth image in a metre.
        pair_within_s: Colour and depth, or left and right, belong together up to this difference of stamps.
        use_depth: False leaves the depth out, and takes one camera unless *right* is named.
        use_stereo: None takes a pair where there is no depth; True takes it always, False its left camera.
        use_imu: None takes an IMU where it can be used; True refuses a bag without one, False takes none.

    Raises:
        UsageError: A number is not above 0.
    """

    colour: str | None = None
    depth: str | None = None
    right: str | None = None
    info: str | None = None
    truth: str | None = None
    imu: str | None = None
    lens: Lens | None = None
    rig: Rig | None = None
    depth_scale: float = 1000.0
    pair_within_s: float = 0.02
    use_depth: bool = True
    use_stereo: bool | None = None
    use_imu: bool | None = None

    def __post_init__(self) -> None:
        for name, value in (("depth_scale", self.depth_scale), ("pair_within_s", self.pair_within_s)):
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} = {value:g} is not above 0", hint="leave it out for the default")


@dataclass(slots=True, eq=False)
class Bag(Closing):
    """The frames of a bag: iterate over it, or read one by its row; close it, or use it in ``with``.

    Frames that are iterated over carry the samples of ``imu``; those that are read do not.
    ``notes`` are sentences for the user: which topics were taken, and what was left out.  ``truth_kind`` is
    ``reference`` for poses that another program estimated.
    """

    name: str
    camera: Camera
    timestamps_s: tuple[float, ...]
    has_depth: bool
    truth: Trajectory | None
    truth_kind: Literal["ground truth", "reference", "none"]
    notes: tuple[str, ...]
    chosen: ChosenTopics
    imu: ImuTrack | None
    _file: BagFile
    _stream: ImageStream
    _pairs: tuple[tuple[tuple[str, int, int], ...], ...]
    _rectify_colour: Rectifier
    _rectify_depth: Rectifier
    _depth_scale: float
    _registration: tuple[Camera, Array] | None = None
    _rectification: Rectification | None = None
    _no_depth: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.float32))

    @property
    def has_stereo(self) -> bool:
        """Whether frames are stereo pairs; then the camera is the rectified left one."""
        return self._rectification is not None

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[Frame]:
        return with_imu(map(self.read, range(len(self))), self.imu)

    def read(self, row: int) -> Frame:
        """Return a frame; rows in ascending order are read without seeking.

        Raises:
            UsageError: The image cannot be decoded.
        """
        raw = self._stream.take(self._pairs[row])
        try:
            colours = decode_colour(self._file.parse(raw[0]))
            if self._rectification is not None:
                return self._stereo_frame(row, self._rectification, colours, raw[1])
            rgb = self._rectify_colour.colour(colours)
            depth_m = self._depth_of(raw)
        except BrokenMessage as error:
            raise UsageError(
                f"{self.name} at {self.timestamps_s[row]:.6f} s: {error}", hint="record the bag again"
            ) from error
        return Frame(timestamp_s=self.timestamps_s[row], rgb=rgb, depth_m=depth_m, camera=self.camera)

    def _stereo_frame(
        self, row: int, rectify: Rectification, colours: npt.NDArray[np.uint8], raw: RawMessage
    ) -> Frame:
        cv2 = load_opencv()
        gray = cv2.cvtColor(decode_colour(self._file.parse(raw)), cv2.COLOR_RGB2GRAY)
        return Frame(
            timestamp_s=self.timestamps_s[row],
            rgb=rectify.left(colours),
            depth_m=self._no_depth,
            camera=self.camera,
            stereo=rectify.right(gray),
            T_body_camera=rectify.T_body_camera,
        )

    def _depth_of(self, raw: list[RawMessage]) -> npt.NDArray[np.float32]:
        if not self.has_depth:
            return self._no_depth
        depth_m = self._rectify_depth.depth(decode_depth(self._file.parse(raw[1]), self._depth_scale))
        if self._registration is None:
            return depth_m
        return register_depth(depth_m, *self._registration, self.camera)

    def close(self) -> None:
        """Release the file; no frame can be read any more."""
        self._stream.close()
        self._file.close()


def open_bag(path: Path | str, options: BagOptions | None = None) -> Bag:
    """Open a ROS 1 bag, or a ROS 2 bag as sqlite3 or MCAP; images are read later.

    Raises:
        UsageError: The bag, or a topic, a camera or a depth image that fits is missing or cannot be used.
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
        {topic: frame for topic, (frame, _) in infos.items()},
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
    lens = _lens_of_colour(file, chosen, infos, options, formats)
    index = read_index(file, chosen, formats)
    rectification, T_left_camera = _rectification(file, chosen, formats, infos, index, options)
    camera = lens.camera if rectification is None else rectification.camera
    pairs = _pairs(name, index, chosen, options)
    rectify_depth, registration, note = _depth_way(file, chosen, formats, infos, lens, index)
    stamps_ns = [pair[0][1] for pair in pairs]
    truth, truth_kind, truth_note = _truth(chosen, formats, index, stamps_ns)
    if truth is not None:
        truth = Trajectory(truth.timestamps_s, truth.T_world_camera @ T_left_camera)
    imu, imu_notes = _imu(chosen, formats, index, np.array(stamps_ns) / 1e9, T_left_camera, options)
    no_depth = np.zeros((camera.height, camera.width), dtype=np.float32)
    no_depth.flags.writeable = False
    return Bag(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamp / 1e9 for stamp in stamps_ns),
        has_depth=chosen.depth is not None,
        truth=truth,
        truth_kind=truth_kind,
        notes=(
            *_notes(chosen, formats, lens, options),
            *_pair_note(rectification),
            *imu_notes,
            *note,
            truth_note,
            *_losses(index, pairs, chosen, options),
        ),
        chosen=chosen,
        imu=imu,
        _file=file,
        _stream=ImageStream(file, list({pair[0] for pair in pairs[0]}), use_log_time=index.uses_log_time),
        _pairs=tuple(pairs),
        _rectify_colour=Rectifier(lens, lens.camera),
        _rectify_depth=rectify_depth,
        _depth_scale=options.depth_scale,
        _registration=registration,
        _rectification=rectification,
        _no_depth=no_depth,
    )


_Lenses = Mapping[str, "tuple[str, RawMessage]"]


def _first_messages(file: BagFile) -> tuple[dict[str, ImageFormat], dict[str, tuple[str, RawMessage]]]:
    """Return what the images of each topic are, and the first message of each camera with its frame."""
    formats: dict[str, ImageFormat] = {}
    infos: dict[str, tuple[str, RawMessage]] = {}
    for topic in file.topics:
        if topic.kind not in (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO) or not topic.messages:
            continue
        for raw in _some(file, topic.name):
            try:
                message = file.parse(raw)
                if topic.kind == CAMERA_INFO:
                    infos[topic.name] = (str(message.header.frame_id), raw)
                else:
                    formats[topic.name] = format_of(message, topic.kind)
            except BrokenMessage:
                continue
            break
    return formats, infos


def _some(file: BagFile, topic: str) -> Iterator[RawMessage]:
    """Yield the first messages of a topic: enough to find one that is not broken."""
    try:
        for number, raw in enumerate(file.messages([topic])):
            if number >= 10:
                return
            yield raw
    except BrokenMessage:
        return


def _lens_of_colour(
    file: BagFile, chosen: ChosenTopics, infos: _Lenses, options: BagOptions, formats: dict[str, ImageFormat]
) -> Lens:
    if options.lens is not None:
        return options.lens
    if options.rig is not None:
        return Lens.of(options.rig.left.lens)
    info = chosen.colour_info
    if info is None or info.name not in infos:
        raise UsageError(
            f"the bag has no camera_info for {chosen.colour.name}; its topics: "
            f"{topics_line(file.topics, formats)}",
            hint="name its topic with --info TOPIC, or give a file with --intrinsics",
        )
    lens = lens_of(file.parse(infos[info.name][1]), info.name, is_rectified=is_rectified(chosen.colour))
    _check_size(chosen.colour.name, formats, info.name, lens.camera)
    return lens


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
    infos: _Lenses,
    index: BagIndex,
    options: BagOptions,
) -> tuple[Rectification | None, Array]:
    """Return how a pair is rectified, and ``(4, 4)`` its left camera's pose in the one as it is."""
    if chosen.right is None:
        return None, np.eye(4)
    if options.rig is not None:
        left, right = options.rig.left, options.rig.right
        if right is None:
            raise UsageError("the rig has one camera", hint="give a rig of two, or take one: --no-depth")
        _check_size(chosen.colour.name, formats, "the rig", left.lens.camera)
        _check_size(chosen.right.name, formats, "the rig", right.lens.camera)
    else:
        if options.lens is not None:
            raise UsageError(
                "the intrinsics are those of one camera, and a pair needs two",
                hint="give --intrinsics rig.json, or take one camera: --no-depth",
            )
        left, right = _pair_of_bag(file, chosen, formats, infos, index)
    rectification = Rectification(left, right)
    return rectification, inverse(left.T_body_camera) @ rectification.T_body_camera


def _pair_of_bag(
    file: BagFile,
    chosen: ChosenTopics,
    formats: dict[str, ImageFormat],
    infos: _Lenses,
    index: BagIndex,
) -> tuple[RigCamera, RigCamera]:
    left, right = chosen.colour_info, chosen.right_info
    assert chosen.right is not None
    if left is None or right is None or right.name not in infos:
        raise UsageError(
            f"the bag has no camera_info for {chosen.right.name}; its topics: "
            f"{topics_line(file.topics, formats)}",
            hint="give both cameras with --intrinsics rig.json, or take one: --no-depth",
        )
    messages = [
        (info.name, file.parse(infos[info.name][1]), is_rectified(topic))
        for info, topic in ((left, chosen.colour), (right, chosen.right))
    ]
    frames = [formats[topic.name].frame for topic in (chosen.colour, chosen.right)]
    are_apart = frames[0].strip("/") != frames[1].strip("/")
    pair = pair_of(messages[0], messages[1], index.tree.between(*frames) if are_apart else None)
    _check_size(chosen.right.name, formats, right.name, pair[1].lens.camera)
    return pair


def _pairs(
    name: str, index: BagIndex, chosen: ChosenTopics, options: BagOptions
) -> list[tuple[tuple[str, int, int], ...]]:
    """Return what each frame is made of: topic, stamp and time of writing of its colours and its depth."""
    colour, second = index.colour, index.second
    topic, partner_topic = chosen.colour.name, chosen.second
    if not len(colour.stamps_ns) or not len(second.stamps_ns):
        bad = topic if not len(colour.stamps_ns) or partner_topic is None else partner_topic.name
        reason = index.first_broken or index.ended or "it has no message"
        raise UsageError(f"{name}: no image of {bad} can be used: {reason}", hint="name another topic")
    wanted = [(topic, int(s), int(log)) for s, log in zip(colour.stamps_ns, colour.log_ns, strict=True)]
    if partner_topic is None:
        return [(row,) for row in wanted]
    rows = pair_stamps(colour.stamps_ns, second.stamps_ns, round(1e9 * options.pair_within_s))
    if not rows:
        gap_s = nearest_gap_s(colour.stamps_ns, second.stamps_ns)
        raise UsageError(
            f"{name}: no image of {topic} has {_partner(chosen)} within {options.pair_within_s:g} s; "
            f"the nearest is {gap_s:.3f} s away",
            hint="widen it with --pair-within S, or check that both drivers use the same clock",
        )
    return [
        (wanted[row], (partner_topic.name, int(second.stamps_ns[partner]), int(second.log_ns[partner])))
        for row, partner in rows
    ]


def _partner(chosen: ChosenTopics) -> str:
    return "depth" if chosen.right is None else "a right one"


def _depth_way(
    file: BagFile,
    chosen: ChosenTopics,
    formats: Mapping[str, ImageFormat],
    infos: _Lenses,
    lens: Lens,
    index: BagIndex,
) -> tuple[Rectifier, tuple[Camera, Array] | None, tuple[str, ...]]:
    """Return how depth images become those of the colour camera: rectified, registered, and what to say."""
    camera, depth = lens.camera, chosen.depth
    if depth is None:
        return Rectifier(Lens(camera=camera), camera), None, ()
    info = chosen.depth_info
    own = None
    if info is not None and info.name in infos:
        own = lens_of(file.parse(infos[info.name][1]), info.name, is_rectified=is_rectified(depth))
    size, frame, colour_frame = (
        formats[depth.name].size,
        formats[depth.name].frame,
        formats[chosen.colour.name].frame,
    )
    same_size = size in (None, (camera.width, camera.height))
    own_fits = own is not None and size in (None, (own.camera.width, own.camera.height))
    if is_registered(depth) or not frame or frame.strip("/") == colour_frame.strip("/"):
        T_colour_depth: Array | None = np.eye(4)
    else:
        T_colour_depth = index.tree.between(colour_frame, frame)
    is_there = T_colour_depth is not None and np.allclose(T_colour_depth, np.eye(4), atol=1e-6)
    if same_size and is_there:
        return Rectifier(own if own is not None and own_fits else lens, camera), None, ()
    if T_colour_depth is not None and own is not None and own_fits:
        note = f"depth is moved from {frame} to {colour_frame}, pixel by pixel"
        return Rectifier(own, own.camera), (own.camera, T_colour_depth), (note,)
    if same_size:
        note = (
            f"{depth.name} is taken as registered to the colours: no transform from {frame} to {colour_frame}"
        )
        return Rectifier(lens, camera), None, (note,)
    raise UsageError(
        f"{depth.name} is not registered to {chosen.colour.name}, and its camera_info or the transform from "
        f"{frame} to {colour_frame} is missing",
        hint="record the registered (aligned) depth topic of your driver, with camera_info and /tf_static",
    )


def _truth(
    chosen: ChosenTopics, formats: Mapping[str, ImageFormat], index: BagIndex, stamps_ns: list[int]
) -> tuple[Trajectory | None, Literal["ground truth", "reference", "none"], str]:
    """Return the true path, its kind, and a sentence about it."""
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
    where = (
        chosen.colour_info.name
        if options.lens is None and options.rig is None and chosen.colour_info
        else "the file of intrinsics"
    )
    distorted = "distorted, so images are undistorted" if lens.distortion else "no distortion"
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
    """Return the samples of the IMU and what to say; one that cannot be used is refused if it is wanted."""
    if chosen.imu is None:
        if options.use_imu:
            raise UsageError("the bag has no IMU", hint="leave out --imu")
        return None, ()
    frame, imu_frame = formats[chosen.colour.name].frame, index.imu.frame
    try:
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


def _losses(
    index: BagIndex, pairs: list[tuple[tuple[str, int, int], ...]], chosen: ChosenTopics, options: BagOptions
) -> tuple[str, ...]:
    """Return a sentence for each thing that was left out or put right."""
    names = []
    unpaired = len(index.colour.stamps_ns) - len(pairs)
    if unpaired:
        names.append(
            f"{_count(unpaired, 'colour image' if chosen.right is None else 'left image')} without "
            f"{_partner(chosen)} within {options.pair_within_s:g} s left out"
        )
    if index.broken:
        names.append(f"{_count(index.broken, 'broken message')} left out; the first: {index.first_broken}")
    copies = index.colour.copies + (index.second.copies if chosen.second is not None else 0)
    if copies:
        names.append(f"{_count(copies, 'message')} with the time stamp of another left out")
    if not (index.colour.was_in_order and index.second.was_in_order):
        names.append("the time stamps were not in order; frames are sorted by them")
    if index.uses_log_time:
        names.append("all time stamps are 0; the times of recording are used")
    if index.ended:
        names.append(f"the bag cannot be read to its end ({index.ended}); what comes before is used")
    return tuple(names)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
