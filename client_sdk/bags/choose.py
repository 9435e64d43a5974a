"""Choose the topics of a bag from which a map is made, by their types and names.

The functions are pure, and read no messages.  A topic that the user names is preferred to all others.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from client_sdk.bags.bag_file import Topic
from client_sdk.bags.images import ImageFormat
from client_sdk.bags.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    IMU,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    TF_OF_ROS1,
)
from rse_pf.errors import UsageError

__all__ = ["ChosenTopics", "choose_topics", "is_rectified", "is_registered", "topics_line"]

_IMAGES = {IMAGE, COMPRESSED_IMAGE}  # message types of images
_POSES = (POSE, POSE_WITH_COVARIANCE, ODOMETRY)  # message types of poses
_TF = {TF, TF_OF_ROS1}  # message types of transforms
_MAX_LISTED = 12  # largest number of topics that an error message lists
_LEFT_RIGHT_NAMES = (("left", "right"), ("cam0", "cam1"), ("infra1", "infra2"), ("image_0", "image_1"))
"""Parts of topic names with which drivers and data sets distinguish the left and the right camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenTopics:
    """The topics from which a map is made; None for a sensor that is missing or not used.

    Attributes:
        colour: Images of the colour camera, or of the left camera of a stereo pair.
        depth: Depth images.
        right: Images of the right camera of a stereo pair.
        colour_info: ``CameraInfo`` of *colour*.
        depth_info: ``CameraInfo`` of *depth*.
        right_info: ``CameraInfo`` of *right*.
        poses: Ground truth or reference poses.
        imu: Samples of the IMU.
        tf: Names of all topics of transforms.
    """

    colour: Topic
    depth: Topic | None
    right: Topic | None
    colour_info: Topic | None
    depth_info: Topic | None
    right_info: Topic | None
    poses: Topic | None
    imu: Topic | None
    tf: tuple[str, ...]

    @property
    def infos(self) -> tuple[str, ...]:
        """The names of the ``CameraInfo`` topics that are used."""
        return tuple(
            info.name for info in (self.colour_info, self.depth_info, self.right_info) if info is not None
        )

    @property
    def second(self) -> Topic | None:
        """The topic of the images that are paired with those of *colour*: depth, or else the right camera."""
        return self.right if self.depth is None else self.depth


def choose_topics(
    topics: Sequence[Topic],
    formats: Mapping[str, ImageFormat],
    info_frames: Mapping[str, str],
    *,
    colour: str | None = None,
    depth: str | None = None,
    right: str | None = None,
    info: str | None = None,
    poses: str | None = None,
    imu: str | None = None,
    use_depth: bool = True,
    use_stereo: bool | None = None,
    use_imu: bool = True,
) -> ChosenTopics:
    """Choose the topics from which a map is made.

    Without depth, a stereo pair is used if the names of the topics show exactly one pair.

    Args:
        topics: All topics of the bag.
        formats: Format of the first message of each image topic, by name of the topic.
        info_frames: Frame of each ``CameraInfo`` topic, by name of the topic.
        colour: Topic of the colour or left images that the user named.  For this and the following topics,
            None lets this function choose.
        depth: Topic of the depth images that the user named.
        right: Topic of the right images that the user named.
        info: Topic of the ``CameraInfo`` of *colour* that the user named.
        poses: Topic of the poses that the user named.
        imu: Topic of the IMU that the user named.
        use_depth: False uses neither depth images nor a stereo pair, unless *right* or *use_stereo* asks for
            a pair.
        use_stereo: True uses a stereo pair even if the bag has depth images; False uses only the left camera
            of a pair; None uses a pair if the bag has no depth images.
        use_imu: Whether to use an IMU.

    Raises:
        UsageError: A topic is missing, or named topics do not fit; the message lists the topics of the bag.
    """
    images = [topic for topic in topics if topic.kind in _IMAGES and topic.messages]
    has_depth = any(formats[each.name].holds == "depth" for each in images if each.name in formats)
    pair = None
    if right is not None or use_stereo or (use_depth and depth is None and not has_depth):
        pair = _choose_pair(topics, images, formats, colour, right)
    if pair is None and use_stereo:
        raise UsageError(
            f"the bag has no pair of cameras, or several; its topics: {topics_line(topics, formats)}",
            hint="name both: --colour TOPIC of the left one, --right TOPIC",
        )
    if pair is not None and depth is not None:
        raise UsageError(
            f"{depth} and a right camera are not used together", hint="leave out --depth or --right"
        )
    if pair is None:
        of_colour, of_right = _choose(topics, images, formats, "colour", colour, None), None
        if colour is None:  # if the chosen topic is the right camera of a pair, use the left one
            lefts = {other.name: one for one, other in _side_pairs(images, formats)}
            of_colour = lefts.get(of_colour.name, of_colour)
    else:
        of_colour, of_right = pair[0], None if use_stereo is False else pair[1]
    of_depth = None
    if use_depth and pair is None:
        of_depth = _choose(topics, images, formats, "depth", depth, formats[of_colour.name])
    infos = [topic for topic in topics if topic.kind == CAMERA_INFO and topic.messages]
    if info is not None:
        colour_info: Topic | None = _find_named(topics, info, {CAMERA_INFO})
    else:
        colour_info = _info_of(of_colour, infos, formats, info_frames)
    right_info = None if of_right is None else _info_of(of_right, infos, formats, info_frames)
    return ChosenTopics(
        colour=of_colour,
        depth=of_depth,
        right=of_right,
        colour_info=colour_info,
        # If both cameras have one frame, the search by frame finds the left camera's topic for the right one.
        right_info=None if right_info == colour_info else right_info,
        depth_info=None if of_depth is None else _info_of(of_depth, infos, formats, info_frames),
        poses=_poses(topics, poses),
        imu=_imu(topics, imu) if use_imu else None,
        tf=tuple(topic.name for topic in topics if topic.kind in _TF),
    )


def is_rectified(topic: Topic) -> bool:
    """Return whether the images of a topic are rectified, by the naming of ROS (``image_rect``)."""
    return "rect" in _base(topic).rpartition("/")[2].split("_")


def is_registered(topic: Topic) -> bool:
    """Return whether the depth of a topic is registered to the colour image, by the naming of drivers."""
    return "aligned" in topic.name or "registered" in topic.name


def topics_line(topics: Sequence[Topic], formats: Mapping[str, ImageFormat]) -> str:
    """Return the topics of a bag with their types and encodings as one line, at most 12 of them."""
    words = []
    for topic in topics:
        kind = topic.kind.replace("/msg/", "/").rpartition("/")[2]
        encoding = f" {formats[topic.name].encoding}" if topic.name in formats else ""
        words.append(f"{topic.name} ({kind}{encoding})")
    more = len(words) - _MAX_LISTED
    listed = ", ".join(words[:_MAX_LISTED]) or "none"
    return f"{listed} and {more} more" if more > 0 else listed


def _choose(
    topics: Sequence[Topic],
    images: Sequence[Topic],
    formats: Mapping[str, ImageFormat],
    wanted: str,
    named: str | None,
    colour_format: ImageFormat | None,
) -> Topic:
    if named is not None:
        topic = _find_named(topics, named, _IMAGES)
        image_format = formats.get(named)
        if image_format is None:
            raise UsageError(f"{named} holds no image that can be read", hint="name another topic")
        if image_format.holds != wanted:
            raise UsageError(
                f"{named} holds {image_format.encoding}, which is not {wanted} that can be read",
                hint=_encodings(wanted),
            )
        return topic
    good = [image for image in images if image.name in formats and formats[image.name].holds == wanted]
    if not good:
        hint = f"{_encodings(wanted)}; or name the topic: --{wanted} TOPIC"
        if wanted == "depth":
            hint = f"use the colours alone with --no-depth, or two cameras with --right TOPIC, or {hint}"
        raise UsageError(f"the bag has no {wanted}; its topics: {topics_line(topics, formats)}", hint=hint)
    most = max(topic.messages for topic in good)
    return max(good, key=lambda each: _preference(each, formats[each.name], wanted, colour_format, most))


def _choose_pair(
    topics: Sequence[Topic],
    images: Sequence[Topic],
    formats: Mapping[str, ImageFormat],
    left: str | None,
    right: str | None,
) -> tuple[Topic, Topic] | None:
    """Return the left and right topic of the pair that the user names, or of the only pair by topic names.

    The result is None if the bag has no such pair, or several.
    """
    pairs = _side_pairs(images, formats)
    if right is not None:
        of_right = _choose(topics, images, formats, "colour", right, None)
        if left is None:
            partners = [one for one, other in pairs if other.name == right]
            if not partners:
                raise UsageError(
                    f"no left camera belongs to {right} by its name", hint="name it: --colour TOPIC"
                )
            left = partners[0].name
        if left == right:
            raise UsageError(f"{left} is named as the left and the right camera", hint="name two topics")
        return _choose(topics, images, formats, "colour", left, None), of_right
    if left is not None:
        return next((pair for pair in pairs if pair[0].name == left), None)
    if len({_base(one).rpartition("/")[0] for one, _ in pairs}) != 1:
        return None
    most = max(one.messages for one, _ in pairs)
    return max(pairs, key=lambda pair: _preference(pair[0], formats[pair[0].name], "colour", None, most))


def _side_pairs(images: Sequence[Topic], formats: Mapping[str, ImageFormat]) -> list[tuple[Topic, Topic]]:
    """Return all pairs of topics of one type whose names differ only in one of `_LEFT_RIGHT_NAMES`."""
    good = {
        (each.name, each.kind): each
        for each in images
        if each.name in formats and formats[each.name].holds == "colour"
    }
    pairs = []
    for (name, kind), left in good.items():
        for one, other in _LEFT_RIGHT_NAMES:
            head, found, tail = name.rpartition(one)
            names = (name.replace(one, other), f"{head}{other}{tail}") if found else ()
            partner = next((good[each, kind] for each in names if (each, kind) in good), None)
            if partner is not None:
                pairs.append((left, partner))
                break
    return pairs


def _preference(
    topic: Topic, image: ImageFormat, wanted: str, colour_format: ImageFormat | None, most: int
) -> tuple[object, ...]:
    """Return a sort key of an image topic; the topic with the largest key is chosen.

    *wanted* is ``colour`` or ``depth``, *colour_format* the format of the colour images for depth, and *most*
    the number of messages of the largest candidate.
    """
    name = topic.name.lower()
    is_raw = topic.kind == IMAGE
    enough = 2 * topic.messages >= most
    if wanted == "colour":
        is_colour = any(word in name for word in ("rgb", "color", "colour"))
        is_other = any(word in name for word in ("infra", "/ir/", "depth", "confidence", "fisheye"))
        is_grey = image.encoding in ("mono8", "8UC1")
        return enough, not is_other, is_colour, not is_grey, is_raw, topic.messages, _short_first(topic.name)
    same_frame = colour_format is not None and image.frame == colour_format.frame
    return enough, is_registered(topic), same_frame, is_raw, topic.messages, _short_first(topic.name)


def _short_first(name: str) -> tuple[int, ...]:
    """Return a sort key that is largest for the shortest name, and among these for the first by alphabet."""
    return (-len(name), *(-ord(letter) for letter in name))


def _find_named(topics: Sequence[Topic], name: str, kinds: set[str]) -> Topic:
    for topic in topics:
        if topic.name == name:
            if topic.kind not in kinds:
                short = " or ".join(sorted(kind.rpartition("/")[2] for kind in kinds))
                raise UsageError(f"{name} is a topic of {topic.kind}", hint=f"name a topic of {short}")
            if not topic.messages:
                raise UsageError(f"{name} has no message", hint="name another topic")
            return topic
    raise UsageError(
        f"the bag has no topic {name}; its topics: {topics_line(topics, {})}", hint="name one of these"
    )


def _encodings(wanted: str) -> str:
    if wanted == "colour":
        return "colours are rgb8, bgr8, rgba8, bgra8, mono8, bayer, yuv422, or JPEG and PNG"
    return "depth is 16UC1, 32FC1, or compressedDepth as PNG"


def _base(topic: Topic) -> str:
    """Return the name of the raw image topic from which the name of a compressed image topic is derived."""
    return _base_of(topic.name) if topic.kind == COMPRESSED_IMAGE else topic.name


def _base_of(name: str) -> str:
    head, _, tail = name.rpartition("/")
    return head if tail.startswith("compressed") else name


def _info_of(
    topic: Topic, infos: Sequence[Topic], formats: Mapping[str, ImageFormat], frames: Mapping[str, str]
) -> Topic | None:
    """Return the ``CameraInfo`` topic of an image topic; None if no topic, or no single one, fits.

    The first of three rules that finds a topic decides: the name that ROS prescribes; a name that shares more
    leading parts with this image topic than with others; the only ``CameraInfo`` with the same frame.

    A RealSense recorder writes ``Color_0/image/data`` and ``Color_0/info/camera_info``, all with one frame.
    """
    base = _base(topic)
    wanted = (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info")
    others = {_base_of(name) for name in formats} - {base}

    def is_own(info: Topic) -> bool:
        shared = _shared(base, info.name)
        return shared > 0 and all(_shared(other, info.name) < shared for other in others)

    frame = formats[topic.name].frame
    same_frame = [info for info in infos if frame and frames.get(info.name) == frame]
    found = [info for info in infos if info.name in wanted] or [info for info in infos if is_own(info)]
    if found:
        return max(found, key=lambda info: _shared(base, info.name))
    return same_frame[0] if len(same_frame) == 1 else None


def _shared(name: str, other: str) -> int:
    """Return the number of leading parts (between slashes) that the names of two topics have in common."""
    parts = zip(name.strip("/").split("/"), other.strip("/").split("/"), strict=False)
    return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], parts))


def _poses(topics: Sequence[Topic], named: str | None) -> Topic | None:
    if named is not None:
        return _find_named(topics, named, set(_POSES))
    pose_topics = [topic for topic in topics if topic.kind == POSE and topic.messages > 1]
    return max(pose_topics, key=lambda each: each.messages, default=None)


def _imu(topics: Sequence[Topic], named: str | None) -> Topic | None:
    """Return the IMU topic *named* by the user, or else that with most messages; None without an IMU topic.

    Topics with ``gyro`` or ``accel`` in their name hold one of the two sensors only, and are not chosen.
    """
    if named is not None:
        return _find_named(topics, named, {IMU})
    whole = [
        topic
        for topic in topics
        if topic.kind == IMU and topic.messages and not any(half in topic.name for half in ("gyro", "accel"))
    ]
    return max(whole, key=lambda each: (each.messages, _short_first(each.name)), default=None)
