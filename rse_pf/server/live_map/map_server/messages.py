"""Decode the requests of robots and operators, and make the replies and updates of a map server.

``docs/protocol.md`` describes their fields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import numpy as np

from rse_pf.errors import BadRequest, UnknownService, message_of
from rse_pf.geometry import Array, scaled
from rse_pf.identity import RobotId
from rse_pf.live_map.events import KeyframeAdded, matrix_bytes
from rse_pf.live_map.outcomes import Alignment, Corrected, Outcome
from rse_pf.maps.registry import MapRecord
from rse_pf.server.live_map.lease import LeaseRecord
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.slam.localise import Localised, PosePrior
from rse_pf.wire.live_map import LIVE_REQUESTS, LiveRequest, PriorPose

__all__ = [
    "MapUpdates",
    "decode_prior",
    "decode_request",
    "paths_reply",
    "relocalise_reply",
    "show_reply",
    "version_reply",
]

Payload = dict[str, Any]
_MAX_PATH_POINTS = 4_000
"""Number of keyframe positions to which the reply of ``live-show`` is thinned; the first and the last
position of each segment are sent in any case.  4,000 positions are about 100 kB of JSON, and a message may
have 256 KiB."""
_UPPER_TRIANGLE = np.triu_indices(6)  # row and column indices of the upper triangle of a 6 x 6 covariance
_FIELDS_NOT_COMPARED = ("cause", "version")
"""Fields of alignment and pose updates that are not compared: an update that differs from the last one in
these fields only is not sent."""


def decode_request(operation: str, data: bytes) -> LiveRequest:
    """Decode the request of *operation* from MessagePack.

    Raises:
        BadRequest: *data* is not a valid request of this operation.
        UnknownService: Live maps have no such operation.
    """
    request_class = LIVE_REQUESTS.get(operation)
    if request_class is None:
        raise UnknownService(
            f"live maps have no operation {operation[:80]!r}",
            hint="use one of the services live-* that docs/protocol.md lists",
        )
    try:
        return msgspec.msgpack.decode(data, type=request_class)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadRequest(
            f"the request {operation} is invalid: {message_of(error)}",
            hint="send the fields that docs/protocol.md lists for this service",
        ) from error


def decode_prior(prior: PriorPose | None) -> PosePrior | None:
    """Return the prior of a request ``live-relocalise``; raises BadRequest if it is not valid."""
    if prior is None:
        return None
    covariance = np.zeros((6, 6))
    covariance[_UPPER_TRIANGLE] = covariance.T[_UPPER_TRIANGLE] = prior.covariance
    return PosePrior(T_map_camera=np.array(prior.T_map_camera).reshape(4, 4), covariance=covariance)


def relocalise_reply(localised: Localised, version: int) -> Payload:
    """Return the reply of ``live-relocalise``; its pose and covariance are None if no pose was found.

    *version* is the position of the map's log at which the search began.
    """
    scale = {} if localised.scale is None else {"scale": localised.scale}
    return {
        "verdict": localised.verdict,
        "reason": localised.reason,
        "T_map_camera": None if localised.T_map_camera is None else matrix_bytes(localised.T_map_camera),
        "covariance": None if localised.covariance is None else _upper_triangle(localised.covariance),
        "inliers": localised.inliers,
        "matches": localised.matches,
        "version": version,
        **scale,
    }


def show_reply(
    robot: RobotId,
    state: MapState,
    lease: LeaseRecord,
    *,
    service_state: str,
    name_of: Callable[[str], str],
    is_present: Callable[[str], bool],
) -> Payload:
    """Return the reply of ``live-show``: the state of a live map, and all robots with keyframes in it.

    ``present`` tells whether a robot contributes now, or has left.

    Args:
        robot: Robot that asks; the field ``you`` says how it numbers its next keyframe and segment.
        state: The map.
        lease: Lease of its map server.
        service_state: The value of ``state`` in updates, such as ``live`` or ``moving``.
        name_of: Returns the displayed name of a robot, given its `RobotId.folder`.
        is_present: Returns whether a robot, given its `RobotId.folder`, contributes now.
    """
    robots = [
        {
            "robot": name_of(alignment.robot),
            "segment": alignment.segment,
            "aligned": alignment.aligned,
            "reason": alignment.reason,
            "keyframes": state.live_map.next_number(alignment.robot),
            "present": is_present(alignment.robot),
        }
        for alignment in state.live_map.alignments()
    ]
    return {
        "keyframes": state.keyframes,
        "robots": robots,
        "owner": lease.owner,
        "server": lease.server,
        "epoch": lease.epoch,
        "version": state.position,
        "links": state.live_map.loop_closure_count,
        "state": service_state,
        "digest": state.digest(),
        "you": {
            "robot": name_of(robot.folder),
            "number": state.live_map.next_number(robot.folder),
            "segment": state.live_map.next_segment(robot.folder),
        },
    }


def paths_reply(state: MapState, name_of: Callable[[str], str]) -> list[Payload]:
    """Return robot, segment and positions (metres, map frame) of the keyframes of all aligned segments.

    Of more than 4,000 keyframes, about 4,000 are chosen evenly, and the first and the last of each segment in
    any case.  Positions are rounded to 1 mm.  *name_of* returns the displayed name of a robot, given its
    `RobotId.folder`.
    """
    return [
        {"robot": name_of(robot), "segment": segment, "points": points.round(3).tolist()}
        for robot, segment, points in state.live_map.paths(_MAX_PATH_POINTS)
    ]


def version_reply(map_name: str, record: MapRecord) -> Payload:
    """Return the reply of ``live-publish`` and ``live-stop``: the version of the map in the registry."""
    return {"name": map_name, "version": record.id, "number": record.number, "keyframes": record.keyframes}


class MapUpdates:
    """The newest update of each key of one live map, which new subscribers get first.

    Keys are ``map``, ``alignment/ROBOT`` and ``pose/ROBOT``, with the displayed name of the robot.  Each
    method that changes updates returns those that must be sent, because they differ from the last one of
    their key.  A difference in ``cause`` or ``version`` alone does not count, except for the key ``map``.
    """

    def __init__(self, name_of: Callable[[str], str]) -> None:
        """Begin without updates; *name_of* returns the displayed name of a robot by its `RobotId.folder`."""
        self._name_of = name_of
        self._newest: dict[str, Payload] = {}
        self._alignments: dict[str, Alignment] = {}  # keyed by RobotId.folder

    def all(self) -> list[Payload]:
        """Return the newest update of each key, that of the key ``map`` first."""
        return sorted(self._newest.values(), key=lambda payload: str(payload["kind"]) != "map")

    def set_alignments(
        self, alignments: Iterable[Alignment], outcomes: Iterable[Outcome], version: int
    ) -> list[Payload]:
        """Replace the alignments of all robots, and return the updates of those that changed.

        Args:
            alignments: The alignment of the newest segment of each robot, also of segments that are not
                aligned.  Updates of robots without an alignment in the list are removed, and nothing is sent
                for them.
            outcomes: Outcomes of the last entry; those of the class `Corrected` name the keyframe that caused
                a correction.
            version: Position of the map in its log, which has nothing to do with versions in the registry.
        """
        causes = {outcome.robot: outcome.cause for outcome in outcomes if isinstance(outcome, Corrected)}
        self._alignments = {alignment.robot: alignment for alignment in alignments}
        changed = []
        for folder, alignment in self._alignments.items():
            cause = causes.get(folder)
            T_map_odom, covariance = alignment.T_map_odom, alignment.covariance
            payload = {
                "kind": "alignment",
                "robot": self._name_of(folder),
                "segment": alignment.segment,
                "aligned": alignment.aligned,
                "reason": alignment.reason,
                "T_map_odom": None if T_map_odom is None else matrix_bytes(T_map_odom),
                "version": version,
                "covariance": None if covariance is None else _upper_triangle(covariance),
                "cause": None if cause is None else {"robot": self._name_of(cause[0]), "number": cause[1]},
            }
            if alignment.scale is not None:
                payload["scale"] = alignment.scale
            changed += self._replace(payload)
        names = [self._name_of(folder) for folder in self._alignments]
        present_keys = {"map", *(f"{kind}/{name}" for kind in ("alignment", "pose") for name in names)}
        for key in self._newest.keys() - present_keys:
            del self._newest[key]
        return changed

    def add_pose(self, event: KeyframeAdded) -> list[Payload]:
        """Set the update ``pose/ROBOT`` to the pose of a new keyframe, and return it if it must be sent.

        Nothing is set or returned if the segment of the keyframe is not aligned with the map.
        """
        alignment = self._alignments.get(event.robot)
        if alignment is None or not alignment.aligned or alignment.segment != event.segment:
            return []
        if alignment.T_map_odom is None:
            return []
        T_map_camera = alignment.T_map_odom @ scaled(event.keyframe.T_odom_camera, alignment.scale or 1.0)
        return self._replace(
            {
                "kind": "pose",
                "robot": self._name_of(event.robot),
                "segment": event.segment,
                "timestamp_s": event.keyframe.timestamp_s,
                "T_map_camera": matrix_bytes(T_map_camera),
            }
        )

    def has_segment(self, event: KeyframeAdded) -> bool:
        """Return whether the alignment of the keyframe's robot belongs to the segment of the keyframe."""
        alignment = self._alignments.get(event.robot)
        return alignment is not None and alignment.segment == event.segment

    def set_map(self, *, keyframes: int, version: int, server: str, state: str) -> list[Payload]:
        """Set the update of the key ``map``; return it if any field has changed.

        Args:
            keyframes: Number of keyframes in the map.
            version: Position of the map in its log.
            server: Id of the backend server on which the map server runs.
            state: ``live``, ``moving`` or ``waiting for the store``.
        """
        payload = {"kind": "map", "keyframes": keyframes, "version": version, "owner": server, "state": state}
        is_new = payload != self._newest.get("map")
        self._newest["map"] = payload
        return [payload] if is_new else []

    def _replace(self, payload: Payload) -> list[Payload]:
        """Store *payload* as the newest update of its key; return a list with it if it must be sent."""
        key = f"{payload['kind']}/{payload['robot']}"
        before = self._newest.get(key)
        self._newest[key] = payload
        is_new = before is None or _compared_fields(before) != _compared_fields(payload)
        return [payload] if is_new else []


def _compared_fields(payload: Payload) -> Payload:
    return {name: value for name, value in payload.items() if name not in _FIELDS_NOT_COMPARED}


def _upper_triangle(covariance: Array) -> bytes:
    """Return the 21 values on and above the diagonal of a ``(6, 6)`` covariance, row by row, as float64."""
    return matrix_bytes(covariance[_UPPER_TRIANGLE])
