"""What robots and operators ask of the owner of a live map, judged and turned into values.

The router of each worker has judged a robot's payload before; the owner does not rely on it.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

import msgspec

from rse_pf.errors import BadRequest, Busy, message_of
from rse_pf.geometry import Camera
from rse_pf.identity import RobotId
from rse_pf.live_map.events import CameraNumbers, KeyframeAdded, matrix_of, pose_bytes
from rse_pf.object_store import name_segment

__all__ = [
    "FORGET",
    "KEYFRAME",
    "LEAVE",
    "PUBLISH",
    "RELOCALISE",
    "SHOW",
    "START",
    "STOP",
    "ForgetRequest",
    "MapMoves",
    "RelocaliseRequest",
    "StartRequest",
    "begins_a_map",
    "camera_of",
    "folders_of",
    "keyframe_event",
    "shown_name",
    "to_request",
]  # fmt: skip

KEYFRAME, RELOCALISE, LEAVE, SHOW = "live-keyframe", "live-relocalise", "live-leave", "live-show"
PUBLISH, STOP, FORGET, START = "live-publish", "live-stop", "live-forget", "live-start"

_T = TypeVar("_T")


class MapMoves(Busy):
    """The map is being given up: the worker sends the request to the next owner.

    Cause: The server of the owner drains, or was paused.
    Check: rse-pf map live list: which server owns the map.
    Fix: Nothing; the worker repeats the request.
    """


class _KeyframeRequest(msgspec.Struct, frozen=True, kw_only=True):
    segment: int
    number: int
    timestamp_s: float
    T_odom_camera: bytes
    camera: CameraNumbers
    features: bytes


class RelocaliseRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Where is this image?  ``features`` is what `keyframe_code` encodes."""

    camera: CameraNumbers
    features: bytes


class ForgetRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Take out what a robot contributed, by its name as shown."""

    robot: str


class StartRequest(msgspec.Struct, frozen=True, kw_only=True, rename={"source": "from"}):
    """Begin with a version of the registry: MAP, MAP@VERSION, or a version of the map of the same name.

    ``equal_rooms_m`` is the size of rooms that look the same, 0 if every place is unique.
    """

    source: str = ""
    equal_rooms_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.0


def to_request(payload: Any, kind: type[_T]) -> _T:
    """Return *payload* as *kind*; raises BadRequest."""
    try:
        return msgspec.convert(payload, kind)
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        raise BadRequest(
            f"the request of the live map is invalid: {message_of(error)}", hint="see docs/protocol.md"
        ) from error


def keyframe_event(robot: RobotId, payload: Any) -> KeyframeAdded:
    """Return the event of a keyframe that *robot* sent; raises BadRequest."""
    request = to_request(payload, _KeyframeRequest)
    return KeyframeAdded(
        robot=robot.folder, segment=request.segment, number=request.number, timestamp_s=request.timestamp_s,
        T_odom_camera=pose_bytes(matrix_of(request.T_odom_camera, 4, 4)), camera=request.camera,
        features=request.features,
    )  # fmt: skip


def camera_of(numbers: CameraNumbers) -> Camera:
    """Return the camera; raises InvalidCamera."""
    fx, fy, cx, cy, width, height = numbers
    return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def begins_a_map(operation: str, payload: dict[str, Any]) -> bool:
    """Return whether a request may begin a map that does not exist, or was stopped.

    A robot's first keyframe does; its later ones belong to the map that was stopped.
    """
    if operation == KEYFRAME:
        return payload.get("number") == 0 and payload.get("segment") == 0
    return operation == START


def shown_name(folder: str) -> str:
    """Return the name of the robot with this `RobotId.folder`, without its enrolment.

    A name that is no plain segment is shown as the digest that stands for it.
    """
    robot = folder.rpartition("/")[2]
    if robot.startswith("x="):
        return "=".join(robot.split("=")[:2])
    return robot.partition("=")[0]


def folders_of(name: str, folders: list[str]) -> list[str]:
    """Return those of *folders* that belong to robots called *name*, whatever their enrolment."""
    wanted = {name, name_segment(name)}
    return [folder for folder in folders if shown_name(folder) in wanted]
