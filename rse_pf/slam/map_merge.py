"""Merge maps: find loop closures, reject outliers, align the maps, optimise the poses, deform the clouds.

`merge_versions` is a function of the maps and the options alone; `rse_pf.services.mapping.merge` is the
service that robots call, and `rse_pf.extensions.batch` runs the same steps in several processes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array, inverse, median_pose
from rse_pf.limits.budget import PROVENANCE, check_msgpack
from rse_pf.maps.format import UP_FIELD, Edge, EdgeKind, MapVersion
from rse_pf.service import Report
from rse_pf.slam.cloud_deform import deform_clouds
from rse_pf.slam.consistency import LoopClosure, OdometryNoise
from rse_pf.slam.loop_closures import (
    Atlas,
    LoopProposals,
    MergeOptions,
    RejectionCounts,
    map_pair_of,
    propose_loop_closures,
    select_consistent,
)
from rse_pf.slam.optimise import (
    OptimisedGraph,
    OptimiseOptions,
    ignore_progress,
    optimise_graph,
)
from rse_pf.slam.ply import Colours, Points
from rse_pf.slam.pose_graph import PoseGraph, is_positive_definite

__all__ = [
    "Atlas",
    "LoopProposals",
    "MergeOptions",
    "MergeSteps",
    "MergedMap",
    "merge_versions",
    "propose_loop_closures",
]

_STEP_NOISE = OdometryNoise(step_m=0.007, step_deg=0.5)
"""Noise of the edge that a merge adds between two consecutive keyframes of a robot which have no edge in
their map: that of a tracker with depth.  The tests of `rse_pf.slam.consistency` use the larger default values
of `OdometryNoise`, so that they reject fewer right loop closures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MergedMap:
    """The result of `merge_versions`.

    Attributes:
        version: The merged map, in the world of the first map.
        joined: Ascending indices of the maps that are part of it; the first map always is.
        not_joined: Index of each other map, with a sentence that says why it was not joined.
        refused: The number of rejected pairs of keyframes, by the indices of their two maps and the reason.
        loops: The number of accepted loop closures between keyframes of the same map, summed over the joined
            maps.
        merges: The number of accepted loop closures between keyframes of two different joined maps.
        cost_before: The robust cost of the pose graph before the optimisation.
        cost_after: The robust cost of the pose graph after it.
    """

    version: MapVersion
    joined: tuple[int, ...]
    not_joined: tuple[tuple[int, str], ...]
    refused: Mapping[tuple[int, int, str], int]
    loops: int
    merges: int
    cost_before: float
    cost_after: float


def _group_by_maps(
    atlas: Atlas, loop_closures: Sequence[LoopClosure]
) -> dict[tuple[int, int], list[LoopClosure]]:
    """Return the loop closures by the indices of the two maps that they connect, the smaller one first."""
    groups: dict[tuple[int, int], list[LoopClosure]] = {}
    for closure in loop_closures:
        groups.setdefault(map_pair_of(atlas, closure.a, closure.b), []).append(closure)
    return groups


def _select(
    atlas: Atlas, proposals: LoopProposals, options: MergeOptions
) -> tuple[list[LoopClosure], RejectionCounts]:
    """Return the consistent loop closures of each pair of maps, and the counts of rejected ones by reason."""
    rejected = Counter(proposals.failed)
    accepted: list[LoopClosure] = []
    for pair, closures in sorted(_group_by_maps(atlas, proposals.loop_closures).items()):
        rows, reasons = select_consistent(pair, closures, atlas.T_world_camera, options)
        accepted += [closures[row] for row in rows]
        rejected.update(reasons)
    return accepted, Counter({key: count for key, count in rejected.items() if count})


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeSteps:
    """The functions of a merge that take long; an extension replaces them to use several processes.

    Attributes:
        propose: Returns the measured loop closures.
        select: Returns the consistent loop closures, and the counts of rejected ones by maps and reason.
        align: Returns further loop closures from aligning point clouds, given the poses ``(n, 4, 4)`` of all
            keyframes in the world of the first map and the accepted loop closures; the default function
            returns none.
        optimise: Returns the optimised poses of a graph; its second argument is the map of each pose.
        deform: Returns the merged point cloud for the new poses ``(n, 4, 4)``; its last argument has the rows
            of the keyframes that are part of the merged map.
    """

    propose: Callable[[Atlas, MergeOptions, Report], LoopProposals] = propose_loop_closures
    select: Callable[[Atlas, LoopProposals, MergeOptions], tuple[list[LoopClosure], RejectionCounts]] = field(
        default=_select
    )
    align: Callable[[Atlas, Array, Sequence[LoopClosure]], list[LoopClosure]] = (
        lambda atlas, T_world_camera, accepted: []
    )
    optimise: Callable[[PoseGraph, npt.NDArray[np.int64], OptimiseOptions], OptimisedGraph] = (
        lambda graph, of_map, options: optimise_graph(graph, options)
    )
    deform: Callable[[Sequence[MapVersion], Atlas, Array, npt.NDArray[np.int64]], tuple[Points, Colours]] = (
        deform_clouds
    )


_IN_THIS_PROCESS = MergeSteps()


def merge_versions(
    versions: Sequence[MapVersion],
    options: MergeOptions | None = None,
    *,
    report: Report = ignore_progress,
    steps: MergeSteps = _IN_THIS_PROCESS,
) -> MergedMap:
    """Merge *versions* into one map in the world of the first one.

    A map that no chain of loop closures connects with the first one is left out; `MergedMap.not_joined` has
    it with the reason.

    Args:
        versions: Maps with at least one keyframe each.
        options: None means the defaults.
        report: Called with the progress; it may raise Cancelled.
        steps: The functions of the steps that take long.

    Raises:
        BadRequest: The maps have descriptors of different kinds, or a map has an edge whose information is
            not positive definite.
        LimitExceeded: More than 700,000 pairs of keyframes would be compared.
        MissingExtra: GTSAM or the native core is not installed.
        Cancelled: *report* raised it.
    """
    options = options or MergeOptions()
    atlas = Atlas.of(versions)
    # 1. Propose loop closures by place recognition and PnP, and reject inconsistent ones.
    proposals = steps.propose(atlas, options, report)
    accepted, rejected = steps.select(atlas, proposals, options)
    report(0.8, f"{len(accepted)} of {len(proposals.loop_closures)} loop closures are consistent")
    # 2. Move every map that is connected with the first one into its world.
    T_world_camera, joined = _align_maps(atlas, accepted)
    used = [c for c in accepted if {int(atlas.of_map[c.a]), int(atlas.of_map[c.b])} <= joined]
    rows = np.flatnonzero(np.isin(atlas.of_map, sorted(joined)))
    # 3. Collect the edges of the joined maps, add loop closures from aligned point clouds, and optimise the
    #    pose graph of all these edges.
    odometry = _odometry_edges(atlas, versions, joined)
    used += steps.align(atlas, T_world_camera, used)
    graph = _make_graph(atlas, T_world_camera, rows, odometry, used)
    optimised = steps.optimise(graph, atlas.of_map[rows], OptimiseOptions(cauchy=options.cauchy))
    report(0.95, "optimised")
    T_world_camera = T_world_camera.copy()
    T_world_camera[rows] = optimised.T_world_pose
    # 4. Move the points of the clouds with their keyframes, and build the merged map.
    points, colours = steps.deform(versions, atlas, T_world_camera, rows)
    version = _make_version(atlas, versions, T_world_camera, rows, odometry, used, points, colours)
    report(1.0, "merged")
    merges = sum(atlas.of_map[closure.a] != atlas.of_map[closure.b] for closure in used)
    return MergedMap(
        version=version,
        joined=tuple(sorted(joined)),
        not_joined=tuple(
            (map_index, _why_not_joined(map_index, joined, rejected, options))
            for map_index in range(len(versions))
            if map_index not in joined
        ),
        refused=rejected,
        loops=len(used) - int(merges),
        merges=int(merges),
        cost_before=optimised.cost_before,
        cost_after=optimised.cost_after,
    )


def _align_maps(atlas: Atlas, accepted: Sequence[LoopClosure]) -> tuple[Array, set[int]]:
    """Express the poses of each map that loop closures connect with map 0, directly or not, in its world.

    Starting from map 0, the map that has most loop closures with one joined map is joined next.  Each of
    these loop closures gives a pose of the new map in the world of map 0; the medoid of these poses is taken
    (`median_pose`), which needs no mean of rotations.

    Returns:
        The poses ``(n, 4, 4)`` of all keyframes, those of unconnected maps unchanged, and the indices of the
        connected maps.
    """
    T_world_camera = atlas.T_world_camera.copy()
    joined = {0}
    groups = {pair: group for pair, group in _group_by_maps(atlas, accepted).items() if pair[0] != pair[1]}
    while True:
        open_pairs = [pair for pair in groups if len(joined & set(pair)) == 1]
        if not open_pairs:
            return T_world_camera, joined
        pair = max(open_pairs, key=lambda pair: (len(groups[pair]), (-pair[0], -pair[1])))
        new_map = pair[0] if pair[1] in joined else pair[1]
        T_world_map = median_pose(
            np.array([_proposed_pose(atlas, T_world_camera, closure, new_map) for closure in groups[pair]])
        )
        rows = atlas.of_map == new_map
        T_world_camera[rows] = T_world_map @ atlas.T_world_camera[rows]
        joined.add(new_map)


def _proposed_pose(atlas: Atlas, T_world_camera: Array, closure: LoopClosure, new_map: int) -> Array:
    """Return the pose of map *new_map* in the world of map 0 that one loop closure gives, ``(4, 4)``."""
    joined_row, new_row, T_joined_new = closure.a, closure.b, closure.T_a_b
    if atlas.of_map[closure.a] == new_map:
        joined_row, new_row, T_joined_new = closure.b, closure.a, inverse(closure.T_a_b)
    T_world_map: Array = T_world_camera[joined_row] @ T_joined_new @ inverse(atlas.T_world_camera[new_row])
    return T_world_map


def _odometry_edges(
    atlas: Atlas, versions: Sequence[MapVersion], joined: set[int]
) -> list[tuple[LoopClosure, EdgeKind]]:
    """Return the edges of the joined maps, of all kinds (also loop closures), each with its kind.

    Consecutive keyframes of a robot without an edge get one from their poses.

    Raises:
        BadRequest: The information of an edge is not positive definite.
    """
    edges: list[tuple[LoopClosure, EdgeKind]] = []
    connected: set[tuple[int, int]] = set()
    # 1. Take over the edges that the joined maps have.
    for map_index in sorted(joined):
        _check_information(map_index, versions[map_index])
        for edge in versions[map_index].edges:
            a, b = atlas.row_of[map_index, edge.a], atlas.row_of[map_index, edge.b]
            edges.append((LoopClosure(a=a, b=b, T_a_b=edge.T_a_b, information=edge.information), edge.kind))
            connected.add((min(a, b), max(a, b)))
    # 2. Add an edge between consecutive keyframes of a robot that have none, from their poses in the map.
    deviations = np.array([_STEP_NOISE.step_m] * 3 + [math.radians(_STEP_NOISE.step_deg)] * 3)
    for a in range(len(atlas.keyframes) - 1):
        b = a + 1
        is_same_drive = (
            atlas.of_map[a] == atlas.of_map[b] and atlas.keyframes[a].robot == atlas.keyframes[b].robot
        )
        if is_same_drive and int(atlas.of_map[a]) in joined and (a, b) not in connected:
            T_a_b = inverse(atlas.T_world_camera[a]) @ atlas.T_world_camera[b]
            information = np.diag(deviations**-2.0)
            edges.append((LoopClosure(a=a, b=b, T_a_b=T_a_b, information=information), "odometry"))
    return edges


def _check_information(map_index: int, version: MapVersion) -> None:
    """Raise BadRequest if the information of an edge of a map is not positive definite."""
    information = np.array([edge.information for edge in version.edges]).reshape(-1, 6, 6)
    if is_positive_definite(information):
        return
    edge = next(edge for edge in version.edges if not is_positive_definite(edge.information[None]))
    raise BadRequest(
        f"map {map_index} (the first is 0): the information of edge {edge.a}-{edge.b} is not symmetric and "
        "positive definite",
        hint="leave that map out",
    )


def _make_graph(
    atlas: Atlas,
    T_world_camera: Array,
    rows: npt.NDArray[np.int64],
    odometry: Sequence[tuple[LoopClosure, EdgeKind]],
    loop_closures: Sequence[LoopClosure],
) -> PoseGraph:
    """Return the pose graph of the keyframes *rows*, whose poses in the graph are in the order of *rows*.

    Edges of the kind "odometry" are taken as free of outliers; all others may be outliers.
    """
    graph_row = np.full(len(atlas.keyframes), -1)
    graph_row[rows] = np.arange(len(rows))
    edges = [edge for edge, _ in odometry] + list(loop_closures)
    robust = [kind != "odometry" for _, kind in odometry] + [True] * len(loop_closures)
    return PoseGraph(
        T_world_pose=T_world_camera[rows],
        a=graph_row[np.array([edge.a for edge in edges], dtype=np.int64)],
        b=graph_row[np.array([edge.b for edge in edges], dtype=np.int64)],
        T_a_b=np.array([edge.T_a_b for edge in edges]).reshape(-1, 4, 4),
        information=np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
        robust=np.array(robust, dtype=np.bool_),
        ids=np.arange(len(rows)),
    )


def _make_version(
    atlas: Atlas,
    versions: Sequence[MapVersion],
    T_world_camera: Array,
    rows: npt.NDArray[np.int64],
    odometry: Sequence[tuple[LoopClosure, EdgeKind]],
    loop_closures: Sequence[LoopClosure],
    points: Points,
    colours: Colours,
) -> MapVersion:
    """Return the merged map.

    Its keyframes are numbered from 0; the provenance has the original map and id of each of them.
    """
    new_id = {int(row): number for number, row in enumerate(rows)}
    edges = list(odometry)
    for closure in loop_closures:
        is_within_map = atlas.of_map[closure.a] == atlas.of_map[closure.b]
        edges.append((closure, "loop" if is_within_map else "merge"))
    return MapVersion(
        keyframes=tuple(
            replace(atlas.keyframes[row], id=new_id[row], T_world_camera=T_world_camera[row])
            for row in new_id
        ),
        edges=tuple(
            Edge(
                a=new_id[edge.a],
                b=new_id[edge.b],
                T_a_b=edge.T_a_b,
                information=edge.information,
                kind=kind,
            )
            for edge, kind in edges
        ),
        points=points,
        colours=colours,
        provenance=_make_provenance(
            versions,
            [[int(atlas.of_map[row]), atlas.keyframes[row].id] for row in new_id],
            versions[int(atlas.of_map[rows[0]])].up,
        ),
    )


def _make_provenance(
    versions: Sequence[MapVersion], origins: list[list[int]], up: Array | None
) -> dict[str, Any]:
    """Return the provenance of the merged map, whose ``parents`` are the provenances of *versions*.

    If the result would exceed the limits of a map's provenance (`rse_pf.limits.budget.PROVENANCE`), the field
    ``parents`` of each of these provenances is left out.  If it still would, the result has no field
    ``parents``.

    Args:
        versions: The merged maps.
        origins: For each keyframe the index of its map and its id there.
        up: The ``(3,)`` direction against gravity in the world of the merged map, if it is known.
    """
    up_field: dict[str, Any] = {} if up is None else {UP_FIELD: up.tolist()}
    complete: list[Mapping[str, Any]] = [dict(version.provenance) for version in versions]
    shortened = [{name: fields[name] for name in fields if name != "parents"} for fields in complete]
    for parents in (complete, shortened):
        provenance = {"made_by": "merge", "from": origins, **up_field, "parents": parents}
        encoded = msgspec.msgpack.encode(provenance)
        try:
            check_msgpack(encoded, PROVENANCE)
        except LimitExceeded:
            continue
        if len(encoded) <= PROVENANCE.wire_bytes:
            return provenance
    return {"made_by": "merge", "from": origins, **up_field}


def _why_not_joined(
    map_index: int,
    joined: set[int],
    rejected: Mapping[tuple[int, int, str], int],
    options: MergeOptions,
) -> str:
    """Return why a map is not part of the merged map: a sentence for the user, with the counts of reasons."""
    counts: Counter[str] = Counter()
    for (first_map, second_map, reason), count in rejected.items():
        if map_index in (first_map, second_map) and first_map != second_map:
            counts[reason] += count
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()) if count)
    return (
        f"fewer than {options.min_links} consistent loop closures with maps {sorted(joined)} "
        f"({reasons or 'no candidates'})"
    )
