"""Snapshots of a live map: all of its state as bytes, whole or in parts.

The *head* of a snapshot holds the pose graph.  A *part* holds the encoded features and the place recognition
vectors of up to 128 keyframes that arrived one after the other, and is named by the SHA-256 of its content.
A full part is written once and used again while at least half of its keyframes keep their features, so that
the next snapshot of a large map writes what is new only.

The names of encoded fields and states are those of earlier releases, because stored snapshots must be read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, message_of
from rse_pf.geometry import Array
from rse_pf.live_map.graph import MapGraph
from rse_pf.live_map.graph_rows import EdgeState, LiveKeyframe, LoopEdge, Segment
from rse_pf.slam.place_recognition import PLACE_VECTOR_SIZE, PlaceIndex

__all__ = [
    "SnapshotParts",
    "SnapshotWriter",
    "decode_graph",
    "decode_parts",
    "decode_places",
    "encode_graph",
]

FORMAT_VERSION = 2  # version of the snapshot format; a snapshot of another version is refused
SCALES_FIELD = "scales"  # name of the extra bytes that hold estimated scales; maps in metres have none
OBJECTS_FIELD = "objects"  # name of the extra bytes that hold digests of robots' objects
PART_KEYFRAMES = 128  # keyframes of one part, about 4 MB of features at 33 kB for each keyframe

_ENCODED_STATES: dict[EdgeState, str] = {"pending": "open", "accepted": "believed", "rejected": "removed"}
"""Encoded name of each state of a loop closure."""
_STATES: dict[str, EdgeState] = {encoded: state for state, encoded in _ENCODED_STATES.items()}

_PackedEdge = tuple[int, int, int, bytes, bytes, int, int, bool, str, int]
"""A loop closure: number, ids of both keyframes, ``T_a_b`` and information as bytes, inliers, matches,
whether it is fixed, encoded state, and misfits in a row."""
_PartRow = tuple[int, bytes, bytes]
"""Id of a keyframe, its encoded features, and its place recognition vector as float32."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotParts:
    """A snapshot: its ``head`` and all ``parts`` by name; a part that is already stored is None."""

    head: bytes
    parts: dict[str, bytes | None]


# --- The pose graph as bytes ---


class _Versioned(msgspec.Struct):
    version: int


class _Packed(msgspec.Struct, kw_only=True):
    """The tables of a `MapGraph`, under the names of earlier releases.

    ``links`` are its edges, ``removed`` the rejected ones, ``open`` the pending numbers, ``agreements`` the
    pair consistency (lower number, higher number, whether both agree), and ``links_of`` the numbers of
    accepted loop closures by id of the keyframe.  ``numbers`` are `MapGraph.next_edge`,
    ``root``, ``events`` and ``optimised_at``.  ``newest`` are the rows of the newest segments by robot,
    ``lookalikes`` the aliased keyframes, ``smoothing`` the smoothing debts.  ``trust`` has the contradictions
    of each segment, and whether it is excluded.  ``left`` held robots that had left in earlier releases, and
    is always empty now.  ``arrays`` are the tables with a row for each
    keyframe, as raw bytes.
    """

    version: int
    keyframes: list[tuple[str, int, int, float, bytes | None]]
    segments: list[tuple[str, int, list[int], int, bytes | None, bytes, str, bool]]
    links: list[_PackedEdge]
    open: list[int]
    agreements: list[tuple[int, int, bool]]
    numbers: tuple[int, int, int, int]
    next_numbers: list[tuple[str, int]]
    newest: list[tuple[str, int]]
    left: list[str]
    source: str
    lookalikes: list[int]
    links_of: list[tuple[str, list[int]]]
    arrays: list[bytes]
    extra: list[tuple[str, bytes]]
    equal_rooms_m: float = 0.0
    removed: list[_PackedEdge] = []
    trust: list[tuple[int, bool]] = []
    smoothing: list[tuple[str, int]] = []


class _PackedScales(msgspec.Struct, kw_only=True):
    """Scales of a map with segments that are not metric.

    ``segments`` are (row, scale, reported scale); ``links`` are (number of the loop closure, logarithm of the
    scale, its variance).
    """

    segments: list[tuple[int, float, float]]
    links: list[tuple[int, float, float]]


class _PackedObjects(msgspec.Struct, kw_only=True):
    """Objects of robots: digests by id of the keyframe, and (robot, digest) of those to be deleted."""

    keyframes: list[tuple[int, tuple[str, ...]]]
    gone: list[tuple[str, str]]


def encode_graph(graph: MapGraph, extra: dict[str, bytes], with_features: bool = True) -> bytes:
    """Return *graph* as bytes, together with *extra* byte strings by name; equal graphs give equal bytes.

    If *with_features* is false, the encoded keyframes are left out: `SnapshotWriter` stores them in parts.
    """
    if graph.has_scales:
        extra = {**extra, SCALES_FIELD: _encode_scales(graph)}
    objects = [(i, keyframe.objects) for i, keyframe in enumerate(graph.keyframes) if keyframe.objects]
    if objects or graph.orphaned_objects:
        packed_objects = _PackedObjects(keyframes=objects, gone=graph.orphaned_objects)
        extra = {**extra, OBJECTS_FIELD: msgspec.msgpack.encode(packed_objects)}
    arrays = (
        graph.T_component_camera,
        graph.T_odom_camera,
        graph.odometry_steps,
        graph.segment_rows,
        graph.positions,
    )
    packed = _Packed(
        version=FORMAT_VERSION,
        keyframes=[
            (each.robot, each.segment, each.number, each.timestamp_s, each.data if with_features else None)
            for each in graph.keyframes
        ],
        segments=[
            (
                segment.robot,
                segment.number,
                segment.keyframes,
                segment.component,
                None if segment.reported_T_map_odom is None else segment.reported_T_map_odom.tobytes(),
                segment.covariance.tobytes(),
                segment.reason,
                segment.is_from_version,
            )
            for segment in graph.segments
        ],
        links=[_pack_edge(number, edge) for number, edge in graph.edges.items()],
        removed=[_pack_edge(number, edge) for number, edge in graph.rejected.items()],
        smoothing=list(graph.smoothing_debt.items()),
        trust=[(segment.contradictions, segment.is_excluded) for segment in graph.segments],
        open=graph.pending,
        agreements=[(*pair, is_consistent) for pair, is_consistent in graph.pair_consistency.items()],
        numbers=(graph.next_edge, graph.root, graph.events, graph.optimised_at),
        next_numbers=list(graph.next_numbers.items()),
        newest=list(graph.newest_segments.items()),
        left=[],
        source=graph.source,
        equal_rooms_m=graph.equal_rooms_m,
        lookalikes=sorted(graph.aliased_keyframes),
        links_of=[(str(i), numbers) for i, numbers in graph.accepted_edges_by_keyframe().items()],
        arrays=[np.ascontiguousarray(array).tobytes() for array in arrays],
        extra=list(extra.items()),
    )
    return msgspec.msgpack.encode(packed)


def decode_graph(data: bytes) -> tuple[MapGraph, dict[str, bytes]]:
    """Return the graph and the extra byte strings that `encode_graph` encoded.

    Raises:
        BadRequest: The snapshot is damaged, or has another format version.
    """
    try:
        version = msgspec.msgpack.decode(data, type=_Versioned).version
        if version != FORMAT_VERSION:
            raise BadRequest(
                f"the snapshot is of version {version}, not {FORMAT_VERSION}",
                hint="publish the map with the release that wrote it: rse-pf map publish MAP; "
                "then start from that version: rse-pf map live start MAP --from MAP",
            )
        packed = msgspec.msgpack.decode(data, type=_Packed)
    except (msgspec.MsgspecError, ValueError) as error:
        raise _damaged(message_of(error)) from error
    extra, orphaned_objects = dict(packed.extra), list[tuple[str, str]]()
    try:
        # 1. Unpack the rows of the tables, with the scales and objects that some maps have.
        keyframes = [LiveKeyframe(*row) for row in packed.keyframes]
        segments = _unpack_segments(packed)
        edges, rejected = _unpack_edges(packed.links), _unpack_edges(packed.removed)
        if SCALES_FIELD in extra:
            _restore_scales(extra.pop(SCALES_FIELD), segments, {**edges, **rejected})
        if OBJECTS_FIELD in extra:
            objects = msgspec.msgpack.decode(extra.pop(OBJECTS_FIELD), type=_PackedObjects)
            orphaned_objects = objects.gone
            for i, digests in objects.keyframes:
                keyframes[i].objects = digests
        # 2. Put the tables into a graph.
        n = len(keyframes)
        layout = {
            "T_component_camera": ("<f8", (4, 4)),
            "T_odom_camera": ("<f8", (4, 4)),
            "odometry_steps": ("<f8", ()),
            "segment_rows": ("<i8", ()),
            "positions": ("<i8", ()),
        }
        next_edge, root, events, optimised_at = packed.numbers
        graph = MapGraph.restore(
            keyframes=keyframes,
            arrays={
                name: np.frombuffer(raw, dtype=np.dtype(kind)).reshape(n, *shape)
                for (name, (kind, shape)), raw in zip(layout.items(), packed.arrays, strict=True)
            },
            accepted_by_keyframe={int(i): numbers for i, numbers in packed.links_of},
            tables={
                "segments": segments,
                "edges": edges,
                "rejected": rejected,
                "pending": packed.open,
                "pair_consistency": {(i, j): is_consistent for i, j, is_consistent in packed.agreements},
                "next_edge": next_edge,
                "root": root,
                "events": events,
                "optimised_at": optimised_at,
                "next_numbers": dict(packed.next_numbers),
                "newest_segments": dict(packed.newest),
                "smoothing_debt": dict(packed.smoothing),
                "source": packed.source,
                "equal_rooms_m": packed.equal_rooms_m,
                "aliased_keyframes": set(packed.lookalikes),
                "orphaned_objects": orphaned_objects,
            },
        )
    except (msgspec.MsgspecError, LookupError, ValueError, ArithmeticError) as error:
        raise _damaged(message_of(error)) from error
    return graph, extra


def _unpack_segments(packed: _Packed) -> list[Segment]:
    segments = []
    for row in packed.segments:
        robot, number, keyframes, component, reported, covariance, reason, is_from_version = row
        segments.append(
            Segment(
                robot=robot,
                number=number,
                keyframes=keyframes,
                component=component,
                reported_T_map_odom=None if reported is None else _matrix(reported, 4),
                covariance=_matrix(covariance, 6),
                reason=reason,
                is_from_version=is_from_version,
            )
        )
    # Snapshots of earlier releases do not have the contradictions: these segments begin without any.
    for segment, (contradictions, is_excluded) in zip(segments, packed.trust, strict=False):
        segment.contradictions, segment.is_excluded = contradictions, is_excluded
    return segments


def _pack_edge(number: int, edge: LoopEdge) -> _PackedEdge:
    return (
        number,
        edge.a,
        edge.b,
        edge.T_a_b.tobytes(),
        edge.information.tobytes(),
        edge.inliers,
        edge.matches,
        edge.is_fixed,
        _ENCODED_STATES[edge.state],
        edge.misfits,
    )


def _unpack_edges(packed: list[_PackedEdge]) -> dict[int, LoopEdge]:
    edges = {}
    for number, a, b, T_a_b, information, inliers, matches, is_fixed, state, misfits in packed:
        if state not in _STATES:
            raise _damaged(f"a loop closure has the unknown state {state!r}")
        edges[number] = LoopEdge(
            a=a,
            b=b,
            T_a_b=_matrix(T_a_b, 4),
            information=_matrix(information, 6),
            inliers=inliers,
            matches=matches,
            is_fixed=is_fixed,
            state=_STATES[state],
            misfits=misfits,
        )
    return edges


def _encode_scales(graph: MapGraph) -> bytes:
    edges = {**graph.edges, **graph.rejected}
    segments = [
        (row, segment.scale, segment.reported_scale)
        for row, segment in enumerate(graph.segments)
        if not segment.is_metric
    ]
    links = [(number, *edge.scale) for number, edge in sorted(edges.items()) if edge.scale is not None]
    return msgspec.msgpack.encode(_PackedScales(segments=segments, links=links))


def _restore_scales(data: bytes, segments: list[Segment], edges: dict[int, LoopEdge]) -> None:
    """Set the encoded scales of segments that are not metric and of their loop closures."""
    packed = msgspec.msgpack.decode(data, type=_PackedScales)
    for row, scale, reported_scale in packed.segments:
        segments[row].is_metric = False
        segments[row].scale, segments[row].reported_scale = scale, reported_scale
    for number, log_ratio, variance in packed.links:
        edges[number].scale = log_ratio, variance


def _matrix(raw: bytes, n: int) -> Array:
    matrix: Array = np.frombuffer(raw, dtype="<f8").reshape(n, n)
    return matrix


# --- The features of keyframes in parts ---


class SnapshotWriter:
    """Encodes snapshots of one map in parts.

    The writer remembers the names and keyframes of full parts, to use them again.  This memory is no state of
    the map: without it a snapshot is encoded anew.
    """

    def __init__(self, full_parts: dict[int, tuple[str, frozenset[int]]] | None = None) -> None:
        """Begin with full parts of an earlier snapshot: name and ids of keyframes, by number of the part.

        The part with number *k*, from 0, is that of the keyframes from 128 *k* on.
        """
        self._full = full_parts or {}

    def encode(self, graph: MapGraph, places: PlaceIndex, stored: Collection[str]) -> SnapshotParts:
        """Return a snapshot; its parts that are used again have no bytes (None).

        A full part is used again if its name is in *stored* and at least half of its keyframes still have
        features.
        """
        names: list[str] = []
        parts: dict[str, bytes | None] = {}
        has_features = graph.has_features
        for number in range(-(-len(graph) // PART_KEYFRAMES)):
            begin = number * PART_KEYFRAMES
            ids = (begin + np.flatnonzero(has_features[begin : begin + PART_KEYFRAMES])).tolist()
            name, members = self._full.get(number, ("", frozenset[int]()))
            if name in stored and members.issuperset(ids) and 2 * len(ids) >= len(members):
                data = None
            else:
                vectors = [places.vector_of(i).astype("<f4").tobytes() for i in ids]
                rows = [(i, graph.keyframes[i].data, vector) for i, vector in zip(ids, vectors, strict=True)]
                data = msgspec.msgpack.encode(rows)
                name = hashlib.sha256(data).hexdigest()
                if begin + PART_KEYFRAMES <= len(graph):
                    self._full[number] = name, frozenset(ids)
            names.append(name)
            parts[name] = data
        extra = {"parts": msgspec.msgpack.encode(names), "held": np.packbits(has_features).tobytes()}
        return SnapshotParts(head=encode_graph(graph, extra, with_features=False), parts=parts)

    def forget(self, keyframes: Iterable[int]) -> None:
        """Encode the parts with these keyframes anew in the next snapshot, without forgotten features."""
        for number in {i // PART_KEYFRAMES for i in keyframes}:
            self._full.pop(number, None)


def decode_parts(
    head: bytes, read_part: Callable[[str], bytes]
) -> tuple[MapGraph, PlaceIndex, SnapshotWriter]:
    """Return the map that `SnapshotWriter.encode` encoded; *read_part* returns the bytes of a part by name.

    Raises:
        BadRequest: The head or a part is damaged, or has another format version.
    """
    graph, extra = decode_graph(head)
    places, full_parts = PlaceIndex(), dict[int, tuple[str, frozenset[int]]]()
    try:
        names = msgspec.msgpack.decode(extra["parts"], type=list[str])
        bits = np.frombuffer(extra["held"], dtype=np.uint8)
        has_features: npt.NDArray[np.bool_] = np.unpackbits(bits, count=len(graph)).astype(np.bool_)
        for number, name in enumerate(names):
            data = read_part(name)
            if hashlib.sha256(data).hexdigest() != name:
                raise _damaged(f"the content of part {number} does not have the digest that is its name")
            rows = msgspec.msgpack.decode(data, type=list[_PartRow])
            for i, features, vector in rows:
                if has_features[i]:
                    graph.restore_features(i, features)
                    places.add(i, np.frombuffer(vector, dtype="<f4", count=PLACE_VECTOR_SIZE))
            if (number + 1) * PART_KEYFRAMES <= len(graph):
                full_parts[number] = name, frozenset(i for i, _, _ in rows)
    except (msgspec.MsgspecError, KeyError, IndexError, ValueError) as error:
        raise _damaged(message_of(error)) from error
    if not np.array_equal(graph.has_features, has_features):
        raise _damaged("the parts do not have the features of all keyframes that the head lists")
    return graph, places, SnapshotWriter(full_parts)


def decode_places(extra: dict[str, bytes]) -> PlaceIndex:
    """Return the index of places that a snapshot holds beside its graph.

    Raises:
        BadRequest: There is none, or it is damaged.
    """
    try:
        return PlaceIndex.from_bytes(extra["places"])
    except (BadRequest, LookupError, ValueError) as error:
        raise _damaged(message_of(error)) from error


def _damaged(reason: str) -> BadRequest:
    return BadRequest(
        f"the snapshot is damaged: {reason}", hint="restore the map from the snapshot before it"
    )
