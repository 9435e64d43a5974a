"""Choose the topics of a bag that a map is made of, by their types and names.

Pure decisions over what is known of the topics; a topic that the user names always wins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from client_sdk.bags.bag_file import Topic
from client_sdk.bags.images import ImageFormat
from client_sdk.bags.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    TF_OF_ROS1,
)
from rse_pf.errors import UsageError

__all__ = ["ChosenTopics", "choose_topics", "is_rectified", "is_registered", "topics_line"]

_IMAGES = {IMAGE, COMPRESSED_IMAGE}
_POSES = (POSE, POSE_WITH_COVARIANCE, ODOMETRY)
_TF = {TF, TF_OF_ROS1}
_MOST_LISTED = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenTopics:
    """The topics that a map is made of; None where there is none, and tf as the names of its topics."""

    colour: Topic
    depth: Topic | None
    colour_info: Topic | None
    depth_info: Topic | None
    poses: Topic | None
    tf: tuple[str, ...]


def choose_topics(
    topics: Sequence[Topic],
    formats: Mapping[str, ImageFormat],
    info_frames: Mapping[str, str],
    *,
    colour: str | None = None,
    depth: str | None = None,
    info: str | None = None,
    poses: str | None = None,
    use_depth: bool = True,
) -> ChosenTopics:
    """Return the topics of a map.

    Args:
        topics: All topics of the bag.
        formats: Name of an image topic to what its first message is.
        info_frames: Name of a ``CameraInfo`` topic to its frame.
        colour: The user's choice, and so are *depth*, *info* (the camera of the colours) and *poses*.
        use_depth: False leaves the depth out.

    Raises:
        UsageError: A topic is missing; the message lists those that were found.
    """
    images = [topic for topic in topics if topic.kind in _IMAGES and topic.messages]
    of_colour = _choose(topics, images, formats, "colour", colour, None)
    of_depth = None
    if use_depth:
        of_depth = _choose(topics, images, formats, "depth", depth, formats[of_colour.name])
    infos = [topic for topic in topics if topic.kind == CAMERA_INFO and topic.messages]
    if info is not None:
        colour_info: Topic | None = _find_named(topics, info, {CAMERA_INFO})
    else:
        colour_info = _info_of(of_colour, infos, formats, info_frames)
    return ChosenTopics(
        colour=of_colour,
        depth=of_depth,
        colour_info=colour_info,
        depth_info=None if of_depth is None else _info_of(of_depth, infos, formats, info_frames),
        poses=_poses(topics, poses),
        tf=tuple(topic.name for topic in topics if topic.kind in _TF),
    )


def is_rectified(topic: Topic) -> bool:
    """Say whether the images of a topic have no distortion any more, by the names that ROS gives them."""
    return "rect" in _base(topic).rpartition("/")[2].split("_")


def is_registered(topic: Topic) -> bool:
    """Say whether depth is in the pixels of the colours, by the names that drivers give it."""
    return "aligned" in topic.name or "registered" in topic.name


def topics_line(topics: Sequence[Topic], formats: Mapping[str, ImageFormat]) -> str:
    """Return the topics of a bag with their types, for one line of an error."""
    words = []
    for topic in topics:
        kind = topic.kind.replace("/msg/", "/").rpartition("/")[2]
        encoding = f" {formats[topic.name].encoding}" if topic.name in formats else ""
        words.append(f"{topic.name} ({kind}{encoding})")
    more = len(words) - _MOST_LISTED
    listed = ", ".join(words[:_MOST_LISTED]) or "none"
    return f"{listed} and {more} more" if more > 0 else listed


def _choose(
    topics: Sequence[Topic],
    images: Sequence[Topic],
    formats: Mapping[str, ImageFormat],
    wanted: str,
    named: str | None,
    beside: ImageFormat | None,
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
            hint = "use the colours alone with --no-depth, or " + hint
        raise UsageError(f"the bag has no {wanted}; its topics: {topics_line(topics, formats)}", hint=hint)
    most = max(topic.messages for topic in good)
    return max(good, key=lambda each: _merit(each, formats[each.name], wanted, beside, most))


def _merit(
    topic: Topic, image: ImageFormat, wanted: str, beside: ImageFormat | None, most: int
) -> tuple[object, ...]:
    """Return what makes a topic the better choice, the weightiest first."""
    name = topic.name.lower()
    is_raw = topic.kind == IMAGE
    enough = 2 * topic.messages >= most
    if wanted == "colour":
        is_colour = any(word in name for word in ("rgb", "color", "colour"))
        is_other = any(word in name for word in ("infra", "/ir/", "depth", "confidence", "fisheye"))
        is_grey = image.encoding in ("mono8", "8UC1")
        return enough, not is_other, is_colour, not is_grey, is_raw, topic.messages, _short_first(topic.name)
    same_frame = beside is not None and image.frame == beside.frame
    return enough, is_registered(topic), same_frame, is_raw, topic.messages, _short_first(topic.name)


def _short_first(name: str) -> tuple[int, ...]:
    """Return a key that prefers short names, and the first of the alphabet."""
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
    """Return the name of the raw topic that a compressed one belongs to."""
    return topic.name.rpartition("/")[0] if topic.kind == COMPRESSED_IMAGE else topic.name


def _info_of(
    topic: Topic, infos: Sequence[Topic], formats: Mapping[str, ImageFormat], frames: Mapping[str, str]
) -> Topic | None:
    """Return the camera of an image topic: its neighbour by name, or one of the same frame."""
    base = _base(topic)
    wanted = (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info")
    for info in infos:
        if info.name in wanted:
            return info
    frame = formats[topic.name].frame
    return next((topic for topic in infos if frame and frames.get(topic.name) == frame), None)


def _poses(topics: Sequence[Topic], named: str | None) -> Topic | None:
    if named is not None:
        return _find_named(topics, named, set(_POSES))
    pose_topics = [topic for topic in topics if topic.kind == POSE and topic.messages > 1]
    return max(pose_topics, key=lambda each: each.messages, default=None)
