"""Publish a live map as a version of the registry of maps, and start a live map from such a version."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rse_pf.errors import BadMessage, BadRequest, InternalError, LimitExceeded
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.live_map.events import MapStarted, StartEdge, StartKeyframe, matrix_bytes
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.graph_rows import LoopEdge, Segment
from rse_pf.live_map.pairwise_consistency import relative_pose_of
from rse_pf.live_map.smoothing import information_of, odometry_information, select_edges
from rse_pf.maps.format import UP, UP_FIELD, Edge, EdgeKind, Keyframe, MapVersion
from rse_pf.slam.inertial import agreed_gravity, upright_rotation
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe, encode_keyframe
from rse_pf.slam.keyframe_points import ObjectReference
from rse_pf.slam.pose_graph import PoseGraph, is_positive_definite

__all__ = [
    "PlacedKeyframes",
    "PointSource",
    "as_internal_error",
    "image_references",
    "paths_of",
    "placed_keyframes",
    "point_sources",
    "started_from",
    "version_of",
    "whole_graph",
]

MAX_IMAGE_REFERENCES = 8_000
"""Newest keyframes of a version whose images are listed in its provenance: a reference needs 75 bytes, and
the registry of maps refuses a provenance above 1 MiB."""
MAX_ROBOT_NAME = 64  # characters of a robot's name in a version; a longer name is cut at its end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSource:
    """The stored point cloud of one keyframe of a version.

    ``reference`` names the object of ``robot``, whose text is that of `RobotId.folder`.  ``camera`` made the
    depth image, and ``T_world_camera`` ``(4, 4)`` is its pose in the world of the version, metres.
    """

    robot: str
    reference: ObjectReference
    camera: Camera
    T_world_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedKeyframes:
    """Keyframes and their present poses in the map.

    ``robots`` are texts of `RobotId.folder`, empty for keyframes of the version that the map started from.
    ``data`` are the encoded keyframes; ``T_map_camera`` is ``(n, 4, 4)``, metres.  ``arrived`` is the number
    of keyframes that have arrived, also those that are not placed: all ids are below it.  ``dropped`` are
    keyframes that are in the map without features.
    """

    arrived: int
    dropped: frozenset[int]
    ids: tuple[int, ...]
    robots: tuple[str, ...]
    data: tuple[bytes, ...]
    T_map_camera: Array


@contextlib.contextmanager
def as_internal_error(prefix: str) -> Iterator[None]:
    """Turn errors about a stored map into InternalError, since the client that asks did not cause them.

    *prefix* begins the message, such as "the live map cannot be published".
    """
    try:
        yield
    except (BadRequest, BadMessage, LimitExceeded) as error:
        raise InternalError(f"{prefix}: {error.message}", hint=error.hint) from error


def started_from(version: MapVersion, source: str) -> MapStarted:
    """Return the event by which a live map starts from *version*, whose full name is *source* (``MAP@ID``).

    Features without a depth are left out; the point cloud of the version is left out as well.
    ``equal_rooms_m`` of the event is 0; the caller sets it.

    Raises:
        InternalError: The information of an edge is not positive definite.
    """
    information = np.array([edge.information for edge in version.edges]).reshape(-1, 6, 6)
    if not is_positive_definite(information):
        raise InternalError(
            f"{source} has an edge whose information is not positive definite",
            hint="start from another version, or from an empty map",
        )
    index_of = {keyframe.id: index for index, keyframe in enumerate(version.keyframes)}
    return MapStarted(
        source=source,
        keyframes=tuple(
            StartKeyframe(robot=keyframe.robot, data=encode_keyframe(SentKeyframe.from_map(keyframe)))
            for keyframe in version.keyframes
        ),
        links=tuple(
            StartEdge(
                a=index_of[edge.a],
                b=index_of[edge.b],
                T_a_b=matrix_bytes(edge.T_a_b),
                information=matrix_bytes(edge.information),
            )
            for edge in version.edges
        ),
    )


@as_internal_error("the live map cannot be published")
def version_of(graph: MapGraph) -> MapVersion:
    """Return the keyframes with features that are connected with the frame of the map, and their edges.

    Odometry edges lead from each such keyframe of a segment to the next one.  If the map did not start from a
    version, and more than half of the robots with an IMU agree on the direction of gravity, the z axis of the
    version points up; else the version has the axes of the live map.

    Raises:
        InternalError: The map holds something that does not fit into a version.
    """
    # 1. Decode the keyframes, and collect the directions of gravity that their IMUs measured.
    ids = [i for i in _aligned_keyframes(graph) if graph.has_features[i]]
    keyframes: list[Keyframe] = []
    down_directions: dict[str, list[Array]] = {}
    for i in ids:
        live = graph.keyframes[i]
        assert live.data is not None
        sent, T_map_camera = decode_keyframe(live.data), graph.T_component_camera[i]
        if sent.imu is not None:
            down_map = T_map_camera[:3, :3] @ sent.imu.down_camera
            down_directions.setdefault(live.robot, []).append(down_map)
        keyframes.append(
            sent.in_map(
                id=i,
                robot=_short_name(live.robot),
                T_world_camera=T_map_camera.copy(),
                metres_per_unit=graph.segment_of(i).scale,
            )
        )
    # 2. Turn the map upright; a map that started from a version keeps the axes of the version.
    is_new = not graph.source
    down = agreed_gravity([np.array(each) for each in down_directions.values()]) if is_new else None
    if down is not None:
        upright = upright_rotation(down)
        keyframes = [
            replace(keyframe, T_world_camera=upright @ keyframe.T_world_camera) for keyframe in keyframes
        ]
    # 3. Collect odometry and accepted loop closures between published keyframes.
    published = set(ids)
    edges: list[Edge] = []
    for segment in _aligned_segments(graph):
        if not segment.is_from_version:
            edges += _odometry_edges(graph, [i for i in segment.keyframes if i in published])
    for edge in graph.edges.values():
        if edge.state == "accepted" and edge.a in published and edge.b in published:
            edges.append(
                Edge(
                    a=edge.a,
                    b=edge.b,
                    T_a_b=relative_pose_of(graph, edge),
                    information=information_of(graph, edge),
                    kind=_kind_of(graph, edge),
                )
            )
    provenance: dict[str, Any] = {"made_by": "live", "from": graph.source}
    if down is not None:
        provenance[UP_FIELD] = list(UP)
    return MapVersion(keyframes=tuple(keyframes), edges=tuple(edges), provenance=provenance)


def point_sources(graph: MapGraph, version: MapVersion) -> tuple[PointSource, ...]:
    """Return where the point cloud of each keyframe of *version*, just made of *graph*, is stored.

    Point clouds of segments that are excluded or not metric are left out.
    """
    sources = []
    for keyframe in version.keyframes:
        live, segment = graph.keyframes[keyframe.id], graph.segment_of(keyframe.id)
        if not live.objects or live.data is None or not segment.is_metric or segment.is_excluded:
            continue
        reference = decode_keyframe(live.data).points
        if reference is not None:
            sources.append(
                PointSource(
                    robot=live.robot,
                    reference=reference,
                    camera=keyframe.camera,
                    T_world_camera=keyframe.T_world_camera,
                )
            )
    return tuple(sources)


def placed_keyframes(graph: MapGraph) -> PlacedKeyframes:
    """Return the keyframes with features that are connected with the frame of the map.

    Those of segments that are excluded or not metric are left out.  Nothing is decoded, so that this takes
    less than a microsecond for each keyframe.
    """
    keyframes = [
        (i, "" if segment.is_from_version else segment.robot, graph.keyframes[i].data)
        for segment in _aligned_segments(graph)
        if segment.is_metric and not segment.is_excluded
        for i in segment.keyframes
    ]
    placed = [(i, robot, data) for i, robot, data in keyframes if data is not None]
    ids, robots, datas = zip(*placed, strict=True) if placed else ((), (), ())
    return PlacedKeyframes(
        arrived=len(graph),
        dropped=frozenset(i for i, _, data in keyframes if data is None),
        ids=ids,
        robots=robots,
        data=datas,
        T_map_camera=graph.T_component_camera[list(ids)],
    )


def paths_of(graph: MapGraph, limit: int) -> list[tuple[str, int, Array]]:
    """Return (robot, segment, positions ``(n, 3)``) of the robots' segments that are connected with the map.

    Positions are in the frame of the map, metres.  About *limit* keyframes, above 0, are chosen evenly over
    all segments; the first and the last keyframe of each segment are among them, also beyond *limit*.
    """
    segments = [segment for segment in _aligned_segments(graph) if not segment.is_from_version]
    stride = -(-sum(len(segment.keyframes) for segment in segments) // limit) or 1
    return [
        (
            segment.robot,
            segment.number,
            graph.T_component_camera[[*segment.keyframes[:-1:stride], segment.keyframes[-1]], :3, 3].copy(),
        )
        for segment in segments
    ]


def image_references(graph: MapGraph, version: MapVersion) -> dict[str, dict[str, dict[str, str]]]:
    """Return the field ``images`` of the provenance of *version*: image digests by robot and id of keyframe.

    The robot is the text of `RobotId.folder`.  The newest 8,000 keyframes are listed; the result is empty if
    none of them has an image.
    """
    images: dict[str, dict[str, str]] = {}
    for keyframe in version.keyframes[-MAX_IMAGE_REFERENCES:]:
        live = graph.keyframes[keyframe.id]
        image = decode_keyframe(live.data).image if live.objects and live.data is not None else None
        if image is not None:
            images.setdefault(live.robot, {})[str(keyframe.id)] = image.digest
    return {"images": images} if images else {}


def whole_graph(graph: MapGraph) -> tuple[PoseGraph, list[int]]:
    """Return all that is connected with the frame of the map as a pose graph, and the ids of its poses.

    Keyframes without features are among them.  The poses are copies; without a frame of the map both results
    are empty.
    """
    ids = _aligned_keyframes(graph)
    index_of = np.full(len(graph), -1, dtype=np.int64)
    index_of[ids] = np.arange(len(ids))
    edges = select_edges(graph, ids)
    pose_graph = PoseGraph(
        T_world_pose=graph.T_component_camera[ids].copy(),
        a=index_of[edges.a],
        b=index_of[edges.b],
        T_a_b=edges.T_a_b,
        information=edges.information,
        robust=edges.numbers >= 0,
        ids=np.array(ids, dtype=np.int64),
    )
    return pose_graph, ids


def _aligned_segments(graph: MapGraph) -> list[Segment]:
    root = graph.root_component()
    return [segment for segment in graph.segments if segment.component == root and segment.keyframes]


def _aligned_keyframes(graph: MapGraph) -> list[int]:
    return sorted(i for segment in _aligned_segments(graph) for i in segment.keyframes)


def _odometry_edges(graph: MapGraph, ids: list[int]) -> list[Edge]:
    """Return edges between consecutive keyframes *ids* of a segment.

    Where keyframes in between have lost their features, the edge is the relative pose of the graph, which is
    more accurate than the odometry over a longer path.  The information is that of the odometry in any case:
    the covariance of the relative pose in the graph is not known, and is smaller.
    """
    edges = []
    for a, b in pairwise(ids):
        is_next = (a, b) in graph.odometry_edges_of(a)
        T_a, T_b = graph.odometry_poses([a, b]) if is_next else graph.T_component_camera[[a, b]]
        steps = float(graph.odometry_steps[b] - graph.odometry_steps[a])
        information = np.diag(odometry_information() / steps)
        edges.append(Edge(a=a, b=b, T_a_b=inverse(T_a) @ T_b, information=information))
    return edges


def _kind_of(graph: MapGraph, edge: LoopEdge) -> EdgeKind:
    if edge.is_fixed:  # The graph does not hold the kind that the edge has in the stored version.
        return "odometry"
    return "merge" if graph.segment_rows[edge.a] != graph.segment_rows[edge.b] else "loop"


def _short_name(folder: str) -> str:
    """Return the name of a robot without its tenant and its enrolment, from the text of `RobotId.folder`."""
    return folder.rpartition("/")[2].partition("=")[0][:MAX_ROBOT_NAME]
