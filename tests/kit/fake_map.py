"""A fake map for tests of map servers: its digest depends on every event and on their order."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from typing import Any, Literal

import msgspec
import numpy as np

from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LoopClosuresMeasured,
    MapStarted,
    Optimised,
    RobotForgotten,
    encode_events,
)
from rse_pf.live_map.outcomes import Added, Alignment, Corrected, Outcome
from rse_pf.live_map.snapshots import SnapshotParts
from rse_pf.live_map.versions import PointSource
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.server.live_map.map_server.environment import GraphOptimiser, MapImplementation
from rse_pf.slam.keyframe import SentKeyframe, UnknownBlock, encode_keyframe, make_features
from rse_pf.wire.live_map import KeyframeRequest

__all__ = ["FAKE_MAP", "FakeMap", "content_of", "keyframe_bytes", "keyframe_request"]

_CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
_CONTENT_KIND = 1000


class FakeMap:
    """A map without SLAM: it refuses keyframes with the content ``bad`` and raises for ``defect``."""

    def __init__(self) -> None:
        self._state: dict[str, Any] = {"digest": "", "keyframes": [], "numbers": {}, "segments": {}}

    @classmethod
    def restore(cls, head: bytes, part: Callable[[str], bytes]) -> FakeMap:
        restored = cls()
        restored._state = msgspec.msgpack.decode(part(head.decode()))
        return restored

    def snapshot_parts(self, known: Collection[str] = ()) -> SnapshotParts:
        data = msgspec.msgpack.encode(self._state)
        name = hashlib.sha256(data).hexdigest()
        return SnapshotParts(head=name.encode(), parts={name: None if name in known else data})

    def digest(self) -> str:
        return str(self._state["digest"])

    def check_keyframe(self, event: KeyframeAdded) -> Literal["new", "known", "ahead"]:
        expected = self.next_number(event.robot)
        if event.number != expected:
            return "known" if event.number < expected else "ahead"
        if content_of(event) == b"bad":
            raise BadRequest("garbage")
        return "new"

    def next_number(self, robot: str) -> int:
        return int(self._state["numbers"].get(robot, 0))

    def next_segment(self, robot: str) -> int:
        return int(self._state["segments"].get(robot, -1)) + 1

    def apply(self, event: Event) -> list[Outcome]:
        if isinstance(event, KeyframeAdded) and content_of(event) == b"defect":
            raise ZeroDivisionError
        self._state["digest"] = hashlib.sha256(self.digest().encode() + encode_events([event])).hexdigest()
        if isinstance(event, KeyframeAdded):
            self._state["keyframes"].append([event.robot, event.number, event.keyframe.timestamp_s])
            self._state["numbers"][event.robot] = event.number + 1
            self._state["segments"][event.robot] = event.segment
            return [Added(id=len(self._state["keyframes"]) - 1)]
        if isinstance(event, LoopClosuresMeasured):
            robot, number, _ = self._state["keyframes"][event.keyframe]
            T = np.eye(4)
            T[0, 3] = len(self._state["keyframes"])
            return [
                Corrected(robot=robot, segment=0, T_map_odom=T, covariance=np.eye(6), cause=(robot, number))
            ]
        if isinstance(event, MapStarted):
            self._state["keyframes"] += [[keyframe.robot, -1, 0.0] for keyframe in event.keyframes]
        if isinstance(event, RobotForgotten):
            rows = self._state["keyframes"]
            self._state["keyframes"] = [row for row in rows if row[0] != event.robot]
            for table in ("numbers", "segments"):
                self._state[table].pop(event.robot, None)
        return []

    def prepare_measurement(
        self, keyframe: int, pieces: int = 1, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        return [lambda: LoopClosuresMeasured(keyframe=keyframe)]

    def prepare_optimisation(self, solve: GraphOptimiser | None = None) -> Callable[[], Optimised]:
        return lambda: Optimised(up_to=0, ids=(), T_map_camera=b"")

    def prepare_relocalisation(self, view: SentKeyframe, prior: Any = None) -> Callable[[], Any]:
        raise BadRequest("the fake map cannot relocalise")

    def alignments(self) -> list[Alignment]:
        T = np.eye(4)
        T[0, 3] = len(self._state["keyframes"])
        return [
            Alignment(
                robot=robot, segment=segment, aligned=True, reason="", T_map_odom=T, covariance=np.eye(6)
            )
            for robot, segment in self._state["segments"].items()
        ]

    def to_version(self) -> MapVersion:
        camera = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
        keyframes = [
            Keyframe(
                id=row,
                robot=robot,
                timestamp_s=timestamp_s,
                T_world_camera=np.eye(4),
                camera=camera,
                pixels=np.zeros((0, 2), np.float32),
                descriptors=np.zeros((0, 32), np.uint8),
                points_camera=np.zeros((0, 3), np.float32),
            )
            for row, (robot, _, timestamp_s) in enumerate(self._state["keyframes"])
        ]
        return MapVersion(keyframes=tuple(keyframes), edges=(), points=np.zeros((0, 3), np.float32))

    def point_sources(self, version: MapVersion) -> tuple[PointSource, ...]:
        return ()

    def image_references(self, version: MapVersion) -> dict[str, Any]:
        return {}

    def paths(self, most: int) -> list[tuple[str, int, Any]]:
        return []

    @property
    def deletable_objects(self) -> list[tuple[str, str]]:
        return []

    @property
    def keyframes(self) -> int:
        return len(self._state["keyframes"])

    @property
    def robots(self) -> tuple[str, ...]:
        return tuple(self._state["numbers"])

    @property
    def contributors(self) -> tuple[str, ...]:
        return tuple(self._state["numbers"])

    @property
    def loop_closure_count(self) -> int:
        return 0


def _started(version: MapVersion, source: str) -> MapStarted:
    from rse_pf.live_map.events import StartKeyframe

    return MapStarted(
        source=source,
        keyframes=tuple(
            StartKeyframe(robot=keyframe.robot, data=keyframe_bytes(0.0, b""))
            for keyframe in version.keyframes
        ),
    )


FAKE_MAP = MapImplementation(empty=FakeMap, restore=FakeMap.restore, started_from=_started)


def keyframe_bytes(timestamp_s: float, content: bytes) -> bytes:
    """Return a keyframe without features, which holds *content* in a block of its own."""
    features = make_features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 32), np.uint8))
    return encode_keyframe(
        SentKeyframe(
            timestamp_s=timestamp_s,
            T_odom_camera=np.eye(4),
            camera=_CAMERA,
            features=features,
            unknown_blocks=(UnknownBlock(_CONTENT_KIND, content),),
        )
    )


def content_of(event: KeyframeAdded) -> bytes:
    """Return the content that was given to `keyframe_bytes`."""
    return event.keyframe.unknown_blocks[0].content


def keyframe_request(number: int, content: bytes = b"good", segment: int = 0) -> KeyframeRequest:
    """Return the request with which a robot sends keyframe *number*."""
    return KeyframeRequest(
        map="m", segment=segment, number=number, keyframe=keyframe_bytes(float(number), content)
    )
