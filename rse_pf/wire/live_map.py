"""Messages between robots and live maps: requests and replies of the services ``live-*``, and updates.

``docs/protocol.md`` describes the same messages.  A pose is a ``(4, 4)`` matrix as 16 numbers in row-major
order.  A covariance holds the 21 numbers of the upper triangle, row after row, of the ``(6, 6)`` covariance
of a twist (metres, then radians) that is applied to the pose from the left.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

import msgspec

from rse_pf.errors import BadRequest
from rse_pf.wire.arrays import Array

__all__ = [
    "FLOOR_PLAN",
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
    "FloorPlanReply",
    "KeyframeKept",
    "KeyframeRequest",
    "LiveFloorPlan",
    "LiveForget",
    "LiveMapRequest",
    "LiveRelocalise",
    "LiveRequest",
    "LiveShow",
    "LiveStart",
    "MapCause",
    "MapUpdate",
    "PoseUpdate",
    "PriorPose",
    "RelocaliseReply",
    "live_topic",
    "map_of_topic",
]

LIVE_TOPIC = "live/"
"""Beginning of the topic of a live map; the name of the map follows."""

# The name of a map: at most 64 lower-case letters, digits and hyphens, not a hyphen first.
_MapName = Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,63}\Z")]
# A text that names a version of a map: "" or "head" for the newest, or the first 6 to 64 digits of its id.
_VERSION = re.compile(r"|head|[0-9a-f]{6,64}")
# A number from 0 that each language's number type can hold.
_Count = Annotated[int, msgspec.Meta(ge=0, le=2**53 - 1)]


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """The base of all requests, replies and updates; a receiver ignores fields that it does not know."""


class LiveMapRequest(_Value, frozen=True, kw_only=True):
    """Request of ``live-leave``, ``live-publish`` and ``live-stop``: the name of a live map of the tenant.

    The robot leaves the map, or an operator publishes a version of it, or ends it.
    """

    map: _MapName


class LiveShow(LiveMapRequest, frozen=True, kw_only=True):
    """Request of ``live-show``: the state of a live map.

    With ``paths`` the reply also holds the positions of the keyframes of all robots in the map.
    """

    paths: bool = False


class KeyframeRequest(_Value, frozen=True, kw_only=True):
    """Request of ``live-keyframe``: add one keyframe of the robot that sends it to the live map.

    ``segment`` numbers the robot's odometry frames, ``number`` its keyframes over all segments, both from 0.
    ``keyframe`` is encoded by `rse_pf.slam.keyframe`.
    """

    map: _MapName
    segment: _Count
    number: _Count
    keyframe: bytes


class KeyframeKept(_Value, frozen=True, kw_only=True):
    """Reply of ``live-keyframe``: the keyframe is stored durably.

    ``number`` is the number of the robot's next keyframe, ``version`` the position in the map's log.
    """

    number: int
    version: int


class PriorPose(_Value, frozen=True, kw_only=True):
    """Where a camera is expected: its pose in the map, and how well it is known.

    ``covariance`` is the upper triangle of the covariance of position (metres) and rotation (radians) about
    the axes of the map.
    """

    T_map_camera: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)]
    covariance: Annotated[list[float], msgspec.Meta(min_length=21, max_length=21)]


class LiveRelocalise(_Value, frozen=True, kw_only=True, omit_defaults=True):
    """Request of ``live-relocalise``: find the pose of ``keyframe`` in the map, by its image features.

    The pose that the keyframe states does not count, and the keyframe is not added to the map.  ``prior``
    says where the camera is expected.
    """

    map: _MapName
    keyframe: bytes
    prior: PriorPose | None = None


class RelocaliseReply(_Value, frozen=True, kw_only=True):
    """Reply of ``live-relocalise``: the pose, whether it can be trusted (``verdict``), and why it cannot.

    With the verdict ``none`` there is no pose.  ``scale`` is the length in metres of the keyframe's unit of
    length; it is absent if this unit is the metre.
    """

    verdict: Literal["ok", "weak", "none"]
    reason: str = ""
    T_map_camera: Array | None = None
    covariance: Array | None = None
    inliers: int = 0
    matches: int = 0
    version: int = 0
    scale: float | None = None


class LiveFloorPlan(LiveMapRequest, frozen=True, kw_only=True):
    """Request of ``live-floor-plan``: which cells of the map are occupied, free or unknown.

    The numbers are those of `rse_pf.slam.occupancy.GridOptions`, in metres; ``up`` is absent if the z axis of
    the map points up.  ``known`` is the id of the newest plan that the robot has.  ``max_age_s`` is how old,
    in seconds, a plan may be to which only keyframes were added since; a correction makes a new one at once.
    """

    known: Annotated[str, msgspec.Meta(max_length=64)] = ""
    max_age_s: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    resolution_m: float = 0.05
    robot_height_m: float = 1.5
    step_m: float = 0.1
    floor_m: float | None = None
    up: tuple[float, float, float] | None = None


class FloorPlanReply(_Value, frozen=True, kw_only=True):
    """Reply of ``live-floor-plan``: the fields of `rse_pf.slam.occupancy.OccupancyGrid`.

    ``plan`` is the id of the plan, and ``version`` the newest position in the map's log that it contains.
    ``cells`` is what `rse_pf.slam.floor_plan_change.encode_change` returned for the plan ``base`` and this
    plan; ``base`` is empty, or the plan that the robot knows.  ``cells`` is empty if it knows this plan.
    """

    plan: str
    version: int
    base: str = ""
    cells: bytes = b""
    rows: int = 0
    columns: int = 0
    origin_m: tuple[float, float] = (0.0, 0.0)
    floor_m: float = 0.0
    T_grid_map: Array | None = None
    points_left_out: int = 0


class LiveForget(_Value, frozen=True, kw_only=True):
    """Request of ``live-forget``: remove from the map everything that ``robot`` has contributed to it."""

    map: _MapName
    robot: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class LiveStart(_Value, frozen=True, kw_only=True):
    """Request of ``live-start``: begin the live map, empty or with a stored version of a map.

    ``from`` names the stored version: NAME, NAME@VERSION or VERSION; it is empty for an empty map.
    ``equal_rooms_m`` is the size in metres of rooms that look the same to a camera, 0 if every place is
    unique.
    """

    map: _MapName
    source: Annotated[str, msgspec.Meta(max_length=160)] = msgspec.field(name="from", default="")
    equal_rooms_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.0

    def source_version(self) -> tuple[str, str]:
        """Return the name of the map and the version that ``source`` names.

        A version without a name is one of this map; a name without a version means ``head``, the newest one.
        """
        name, at, version = self.source.partition("@")
        if at:
            return name, version
        return (self.map, name or "head") if _VERSION.fullmatch(name) else (name, "head")


LiveRequest = KeyframeRequest | LiveRelocalise | LiveFloorPlan | LiveMapRequest | LiveForget | LiveStart
"""A request that the map server of a live map answers."""
# Names of the services of live maps.
KEYFRAME = "live-keyframe"  # a robot adds a keyframe
RELOCALISE = "live-relocalise"  # a robot asks for the pose of a keyframe in the map
FLOOR_PLAN = "live-floor-plan"  # a robot asks which cells are occupied or free
LEAVE = "live-leave"  # a robot leaves the map
SHOW = "live-show"  # returns the state of the map
PUBLISH = "live-publish"  # stores a version of the map
STOP = "live-stop"  # ends the map
FORGET = "live-forget"  # removes what one robot contributed
START = "live-start"  # begins a map
LIVE_REQUESTS: dict[str, type[LiveRequest]] = {
    KEYFRAME: KeyframeRequest,
    RELOCALISE: LiveRelocalise,
    FLOOR_PLAN: LiveFloorPlan,
    LEAVE: LiveMapRequest,
    SHOW: LiveShow,
    PUBLISH: LiveMapRequest,
    STOP: LiveMapRequest,
    FORGET: LiveForget,
    START: LiveStart,
}
"""By name of a service that the map server of a live map answers: the type of its request."""


class MapCause(_Value, frozen=True, kw_only=True):
    """The robot and the number of the keyframe that caused a correction of an alignment."""

    robot: str
    number: int


class AlignmentUpdate(_Value, frozen=True, kw_only=True):
    """Payload of the key ``alignment/ROBOT``: the pose of a robot's odometry frame in the map.

    ``reason`` says why the segment is not ``aligned``.  ``scale`` is the length in metres of the segment's
    unit of length: multiply the lengths of the segment by it before you apply ``T_map_odom``.  It is absent
    if this unit is the metre.
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
    """Payload of the key ``pose/ROBOT``: the pose of a robot's newest keyframe in the map."""

    robot: str
    segment: int
    timestamp_s: float
    T_map_camera: Array


class MapUpdate(_Value, frozen=True, kw_only=True):
    """Payload of the key ``map``: the size and the state of the live map.

    ``owner`` is the name of the backend server that runs the map server of this map.
    """

    keyframes: int
    version: int
    owner: str = ""
    state: str = "live"


def live_topic(map_name: str) -> str:
    """Return the topic of the updates of the live map *map_name*."""
    return LIVE_TOPIC + map_name


def map_of_topic(topic: str) -> str:
    """Return the name of the live map that *topic* is about.

    Raises:
        BadRequest: *topic* is not the topic of a live map, or the name of the map is malformed.
    """
    name = topic.removeprefix(LIVE_TOPIC)
    try:
        if name == topic:
            raise ValueError
        return msgspec.convert(name, _MapName)
    except (ValueError, msgspec.ValidationError) as error:
        raise BadRequest(f"no topic {topic[:80]!r}", hint="topics of live maps are live/NAME") from error
