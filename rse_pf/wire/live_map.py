"""Messages between robots and live maps: requests of the services ``live-*``, replies and updates.

``docs/protocol.md`` describes the same messages.  Poses are ``(4, 4)``, row-major, flat; a covariance holds
the 21 numbers of the upper triangle, row after row, of the ``(6, 6)`` covariance of the twist (metres, then
radians) on the left of its pose.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

import msgspec

from rse_pf.errors import BadRequest
from rse_pf.wire.arrays import Array

__all__ = [
    "FORGET",
    "KEYFRAME",
    "LEAVE",
    "LIVE_REQUESTS",
    "LIVE_TOPIC",
    "PUBLISH",
    "RELOCALISE",
    "SHOW",
    "START",
    "STOP",
    "AlignmentUpdate",
    "KeyframeKept",
    "KeyframeRequest",
    "LiveForget",
    "LiveMapRequest",
    "LiveRelocalise",
    "LiveRequest",
    "LiveShow",
    "LiveStart",
    "MapCause",
    "MapUpdate",
    "PoseUpdate",
    "RelocaliseReply",
    "live_topic",
    "map_of_topic",
]

LIVE_TOPIC = "live/"
"""Beginning of the topics of live maps; the name of the map follows."""

_MapName = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,63}\Z")]
_VERSION = re.compile(r"|head|[0-9a-f]{6,64}")
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**53 - 1)]


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """Unknown fields are ignored."""


class LiveMapRequest(_Value, frozen=True, kw_only=True):
    """``live-leave``, ``live-publish`` and ``live-stop``: the name of a map of the tenant."""

    map: _MapName


class LiveShow(LiveMapRequest, frozen=True, kw_only=True):
    """``live-show``; with ``paths``, where the keyframes of all robots lie in the map, too."""

    paths: bool = False


class KeyframeRequest(_Value, frozen=True, kw_only=True):
    """``live-keyframe``: one keyframe of the robot that sends it.

    ``segment`` counts the robot's odometry frames, ``number`` its keyframes over all segments, both from 0.
    ``keyframe`` is encoded by `rse_pf.slam.keyframe`.
    """

    map: _MapName
    segment: _Count
    number: _Count
    keyframe: bytes


class KeyframeKept(_Value, frozen=True, kw_only=True):
    """The keyframe is durable: the ``number`` that comes next, and the position in the map's log."""

    number: int
    version: int


class LiveRelocalise(_Value, frozen=True, kw_only=True):
    """``live-relocalise``: find the pose of this keyframe in the map, without regard to the pose in it."""

    map: _MapName
    keyframe: bytes


class RelocaliseReply(_Value, frozen=True, kw_only=True):
    """The pose with its verdict, and why it is not ``ok``; ``none`` comes without a pose.

    ``scale`` is how many metres the unit of the keyframe is, none if it is a metre.
    """

    verdict: Literal["ok", "weak", "none"]
    reason: str = ""
    T_map_camera: Array | None = None
    covariance: Array | None = None
    inliers: int = 0
    matches: int = 0
    version: int = 0
    scale: float | None = None


class LiveForget(_Value, frozen=True, kw_only=True):
    """``live-forget``: take out of the map what one robot contributed."""

    map: _MapName
    robot: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class LiveStart(_Value, frozen=True, kw_only=True):
    """``live-start``: begin the map, empty or with a version of the registry, NAME or NAME@VERSION.

    ``equal_rooms_m`` is the size of rooms that look the same, 0 if every place is unique.
    """

    map: _MapName
    source: Annotated[str, msgspec.Meta(max_length=160)] = msgspec.field(name="from", default="")
    equal_rooms_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.0

    def source_version(self) -> tuple[str, str]:
        """Return the map and the version that ``source`` names; a version alone is one of this map."""
        name, at, version = self.source.partition("@")
        if at:
            return name, version
        return (self.map, name or "head") if _VERSION.fullmatch(name) else (name, "head")


LiveRequest = KeyframeRequest | LiveRelocalise | LiveMapRequest | LiveForget | LiveStart
"""What the owner of a map is asked for."""
KEYFRAME, RELOCALISE, LEAVE, SHOW = "live-keyframe", "live-relocalise", "live-leave", "live-show"
PUBLISH, STOP, FORGET, START = "live-publish", "live-stop", "live-forget", "live-start"
LIVE_REQUESTS: dict[str, type[LiveRequest]] = {
    KEYFRAME: KeyframeRequest,
    RELOCALISE: LiveRelocalise,
    LEAVE: LiveMapRequest,
    SHOW: LiveShow,
    PUBLISH: LiveMapRequest,
    STOP: LiveMapRequest,
    FORGET: LiveForget,
    START: LiveStart,
}
"""The request of each service that the owner of a map answers."""


class MapCause(_Value, frozen=True, kw_only=True):
    """The keyframe that caused a correction."""

    robot: str
    number: int


class AlignmentUpdate(_Value, frozen=True, kw_only=True):
    """Payload of the key ``alignment/ROBOT``: where a robot's odometry frame lies in the map.

    ``scale`` is how many metres the unit of the segment is, by which its lengths are multiplied before
    ``T_map_odom``; none if it is a metre.
    """

    robot: str
    segment: int
    aligned: bool
    reason: str = ""
    T_map_odom: Array | None = None
    covariance: Array | None = None
    version: int = 0
    cause: MapCause | None = None
    scale: float | None = None


class PoseUpdate(_Value, frozen=True, kw_only=True):
    """Payload of the key ``pose/ROBOT``: where a robot's newest keyframe was made."""

    robot: str
    segment: int
    timestamp_s: float
    T_map_camera: Array


class MapUpdate(_Value, frozen=True, kw_only=True):
    """Payload of the key ``map``: its size, and who serves it."""

    keyframes: int
    version: int
    owner: str = ""
    state: str = "live"


def live_topic(map_name: str) -> str:
    """Return the topic of the updates of a live map."""
    return LIVE_TOPIC + map_name


def map_of_topic(topic: str) -> str:
    """Return the name of the live map that *topic* is about; raises BadRequest."""
    name = topic.removeprefix(LIVE_TOPIC)
    try:
        if name == topic:
            raise ValueError
        return msgspec.convert(name, _MapName)
    except (ValueError, msgspec.ValidationError) as error:
        raise BadRequest(f"no topic {topic[:80]!r}", hint="topics of live maps are live/NAME") from error
