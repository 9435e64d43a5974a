"""Between a live map and versions of the registry: publish what is connected, and start from one."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rse_pf.errors import BadMessage, BadRequest, InternalError, LimitExceeded
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.live_map.events import MapStarted, StartEdge, StartKeyframe, matrix_bytes
from rse_pf.live_map.graph import Graph, Segment
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.live_map.smoothing import edges_of, link_information
from rse_pf.maps.format import UP, UP_FIELD, Edge, EdgeKind, Keyframe, MapVersion
from rse_pf.slam.inertial import agreed_gravity, upright_rotation
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe, encode_keyframe
from rse_pf.slam.keyframe_points import ObjectReference
from rse_pf.slam.pose_graph import PoseGraph, is_positive_definite

__all__ = [
    "PointSource",
    "as_internal_error",
    "image_references",
    "paths_of",
    "point_sources",
    "started_from",
    "version_of",
    "whole_graph",
]

_MAX_IMAGES = 8_000
"""75 bytes each: a provenance has 1 MiB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSource:
    """The points of one keyframe of a version: an object of ``robot``, a `RobotId.folder`, and its pose.

    ``T_world_camera`` is ``(4, 4)``, in the world of the version.
    """

    robot: str
    reference: ObjectReference
    camera: Camera
    T_world_camera: Array


@contextlib.contextmanager
def as_internal_error(what: str) -> Iterator[None]:
    """Raise what is wrong with a map that is kept as InternalError: who asks for it has not caused it.

    Args:
        what: Begin of the message, such as "the live map cannot be published".
    """
    try:
        yield
    except (BadRequest, BadMessage, LimitExceeded) as error:
        raise InternalError(f"{what}: {error.message}", hint=error.hint) from error


def started_from(version: MapVersion, source: str) -> MapStarted:
    """Return the event by which a live map starts from *version*, which is called *source*.

    Features without a depth are left out; the cloud of points is not taken over.

    Raises:
        InternalError: An edge of the version has no usable information.
    """
    information = np.array([each.information for each in version.edges]).reshape(-1, 6, 6)
    if not is_positive_definite(information):
        raise InternalError(
            f"{source} has an edge whose information is not positive definite",
            hint="start from another version, or from an empty map",
        )
    row = {keyframe.id: number for number, keyframe in enumerate(version.keyframes)}
    return MapStarted(
        source=source,
        keyframes=tuple(
            StartKeyframe(robot=keyframe.robot, data=encode_keyframe(SentKeyframe.from_map(keyframe)))
            for keyframe in version.keyframes
        ),
        links=tuple(
            StartEdge(
                a=row[each.a], b=row[each.b], T_a_b=matrix_bytes(each.T_a_b),
                information=matrix_bytes(each.information),
            )
            for each in version.edges
        ),
    )  # fmt: skip


def version_of(graph: Graph, options: LiveMapOptions) -> MapVersion:
    """Return the keyframes that are connected with the map's frame and keep their features, and their edges.

    Odometry leads from each such keyframe of a segment to the next one.  Where more than half of the robots
    with an IMU agree on where down is, z of the version points up.

    Raises:
        InternalError: Something that the map holds does not fit into a version.
    """
    with as_internal_error("the live map cannot be published"):
        return _version_of(graph, options)


def _version_of(graph: Graph, options: LiveMapOptions) -> MapVersion:
    ids = [i for i in _aligned(graph) if graph.held[i]]
    keyframes: list[Keyframe] = []
    downs: dict[str, list[Array]] = {}
    for i in ids:
        row = graph.keyframes[i]
        assert row.data is not None
        seen = decode_keyframe(row.data)
        if seen.imu is not None:
            downs.setdefault(row.robot, []).append(graph.T[i, :3, :3] @ seen.imu.down_camera)
        keyframes.append(
            seen.in_map(
                id=i,
                robot=_short_name(row.robot),
                T_world_camera=graph.T[i].copy(),
                metres_per_unit=graph.segment_of(i).scale,
            )
        )
    # A map that started from a version keeps the axes of that.
    down = None if graph.source else agreed_gravity([np.array(each) for each in downs.values()])
    if down is not None:
        turn = upright_rotation(down)
        keyframes = [
            replace(keyframe, T_world_camera=turn @ keyframe.T_world_camera) for keyframe in keyframes
        ]
    kept = set(ids)
    edges = []
    for segment in _aligned_segments(graph):
        if not segment.version:
            edges += _odometry(graph, [i for i in segment.keyframes if i in kept], options)
    for link in graph.links.values():
        if link.state == "believed" and link.a in kept and link.b in kept:
            across = graph.of_segment[link.a] != graph.of_segment[link.b]
            kind: EdgeKind = "odometry" if link.fixed else "merge" if across else "loop"
            edges.append(
                Edge(
                    a=link.a, b=link.b, T_a_b=graph.step_of(link), information=link_information(graph, link),
                    kind=kind,
                )
            )  # fmt: skip
    provenance: dict[str, Any] = {"made_by": "live", "from": graph.source}
    if down is not None:
        provenance[UP_FIELD] = list(UP)
    return MapVersion(keyframes=tuple(keyframes), edges=tuple(edges), provenance=provenance)


def point_sources(graph: Graph, version: MapVersion) -> tuple[PointSource, ...]:
    """Return where the points of the keyframes of *version* are, which was just made of *graph*.

    Points of a segment without metres, or that the map does not believe, are left out.
    """
    sources = []
    for keyframe in version.keyframes:
        row, segment = graph.keyframes[keyframe.id], graph.segment_of(keyframe.id)
        if not row.objects or row.data is None or not segment.is_metric or segment.disbelieved:
            continue
        reference = decode_keyframe(row.data).points
        if reference is not None:
            sources.append(
                PointSource(
                    robot=row.robot, reference=reference, camera=keyframe.camera,
                    T_world_camera=keyframe.T_world_camera,
                )
            )  # fmt: skip
    return tuple(sources)


def paths_of(graph: Graph, most: int) -> list[tuple[str, int, Array]]:
    """Return robot, segment and ``(n, 3)`` positions of the keyframes in the map's frame, metres.

    They are those of robots' segments that are connected with it, an even choice of *most* keyframes or a
    few more: the first and the last of each segment are there.
    """
    segments = [each for each in _aligned_segments(graph) if not each.version]
    each_one = -(-sum(len(segment.keyframes) for segment in segments) // most) or 1
    return [
        (
            segment.robot,
            segment.segment,
            graph.T[[*segment.keyframes[:-1:each_one], segment.keyframes[-1]], :3, 3].copy(),
        )
        for segment in segments
    ]


def image_references(graph: Graph, version: MapVersion) -> dict[str, dict[str, dict[str, str]]]:
    """Return ``images`` of the provenance of *version*: digests by robot's folder and id of the keyframe.

    They are those of the newest 8,000 keyframes; nothing without an image.
    """
    images: dict[str, dict[str, str]] = {}
    for keyframe in version.keyframes[-_MAX_IMAGES:]:
        row = graph.keyframes[keyframe.id]
        image = decode_keyframe(row.data).image if row.objects and row.data is not None else None
        if image is not None:
            images.setdefault(row.robot, {})[str(keyframe.id)] = image.digest
    return {"images": images} if images else {}


def whole_graph(graph: Graph, options: LiveMapOptions) -> tuple[PoseGraph, list[int]]:
    """Return all that is connected with the map's frame as a pose graph, and the ids of its rows."""
    ids = _aligned(graph)
    rows = np.full(len(graph), -1, dtype=np.int64)
    rows[ids] = np.arange(len(ids))
    edges = edges_of(graph, ids, options)
    pose_graph = PoseGraph(
        T_world_pose=graph.T[ids].copy(), a=rows[edges.a], b=rows[edges.b], T_a_b=edges.T_a_b,
        information=edges.information, robust=edges.numbers >= 0, ids=np.array(ids, dtype=np.int64),
    )  # fmt: skip
    return pose_graph, ids


def _aligned_segments(graph: Graph) -> list[Segment]:
    if graph.root < 0:
        return []
    root = graph.segments[graph.root].component
    return [segment for segment in graph.segments if segment.component == root and segment.keyframes]


def _aligned(graph: Graph) -> list[int]:
    return sorted(i for segment in _aligned_segments(graph) for i in segment.keyframes)


def _odometry(graph: Graph, ids: list[int], options: LiveMapOptions) -> list[Edge]:
    """Return edges between consecutive keyframes of a segment, as the graph has them.

    Where keyframes in between are gone, the pose is that of the graph, which knew more than odometry.
    """
    spread = np.array([options.drift.step_m] * 3 + [math.radians(options.drift.step_deg)] * 3) ** -2.0
    edges = []
    for a, b in pairwise(ids):
        is_next = graph.next_in_segment(a) == b
        from_a, to_b = graph.odometry([a, b]) if is_next else graph.T[[a, b]]
        walked = float(graph.way[b] - graph.way[a])
        edges.append(Edge(a=a, b=b, T_a_b=inverse(from_a) @ to_b, information=np.diag(spread / walked)))
    return edges


def _short_name(folder: str) -> str:
    """Return the name of a robot without its tenant and its enrolment."""
    return folder.rpartition("/")[2].partition("=")[0][:64]
