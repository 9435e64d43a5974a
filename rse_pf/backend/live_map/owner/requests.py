"""What robots and operators ask of the owner of a live map, between a worker and the owner.

The router of each worker has judged a robot's payload before; the owner does not rely on it.
"""

from __future__ import annotations

import msgspec

from rse_pf.errors import BadRequest, Busy, UnknownService, message_of
from rse_pf.object_store import name_segment
from rse_pf.wire.live_map import LIVE_REQUESTS, KeyframeRequest, LiveRequest, LiveStart

__all__ = [
    "FORGET",
    "KEYFRAME",
    "LEAVE",
    "PUBLISH",
    "RELOCALISE",
    "SHOW",
    "START",
    "STOP",
    "MapMoves",
    "begins_a_map",
    "decode_request",
    "encode_request",
    "folders_of",
    "shown_name",
]  # fmt: skip

KEYFRAME, RELOCALISE, LEAVE, SHOW = "live-keyframe", "live-relocalise", "live-leave", "live-show"
PUBLISH, STOP, FORGET, START = "live-publish", "live-stop", "live-forget", "live-start"


class MapMoves(Busy):
    """The map is being given up: the worker sends the request to the next owner.

    Cause: The server of the owner drains, or was paused.
    Check: rse-pf map live list: which server owns the map.
    Fix: Nothing; the worker repeats the request.
    """


def encode_request(request: LiveRequest) -> bytes:
    """Return *request* as the connection between a worker and an owner carries it."""
    return msgspec.msgpack.encode(request)


def decode_request(operation: str, data: bytes) -> LiveRequest:
    """Return the request of *operation* that `encode_request` encoded.

    Raises:
        BadRequest: The bytes are no such request.
        UnknownService: There is no such operation.
    """
    kind = LIVE_REQUESTS.get(operation)
    if kind is None:
        raise UnknownService(f"no operation {operation[:80]!r} of live maps", hint="see docs/protocol.md")
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadRequest(
            f"the request of the live map is invalid: {message_of(error)}", hint="see docs/protocol.md"
        ) from error


def begins_a_map(request: LiveRequest) -> bool:
    """Return whether a request may begin a map that does not exist, or was stopped.

    A robot's first keyframe does; its later ones belong to the map that was stopped.
    """
    if isinstance(request, KeyframeRequest):
        return request.number == 0 and request.segment == 0
    return isinstance(request, LiveStart)


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
