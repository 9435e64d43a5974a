"""Merge maps: propose loop closures, select consistent ones, align the maps, optimise, deform the clouds.

A pure function of the maps and the options; `merge` is the service.
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

from rse_pf.budget import PROVENANCE, check_msgpack
from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array, inverse, median_pose
from rse_pf.maps.format import UP_FIELD, Edge, MapVersion
from rse_pf.service import Report
from rse_pf.slam.cloud_deform import deform_clouds
from rse_pf.slam.consistency import LoopClosure, OdometryNoise
from rse_pf.slam.links import (
    Atlas,
    LoopProposals,
    MergeOptions,
    Refused,
    agreeing_links,
    maps_of,
    propose_links,
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
    "propose_links",
]

_DRIFT = OdometryNoise(step_m=0.007, step_deg=0.5)
"""The drift of a tracker with depth; whether a loop may be true is judged by the larger default."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MergedMap:
    """The result of `merge_versions`: the map, the joined and not joined maps, and the refused links."""

    version: MapVersion
    joined: tuple[int, ...]
    not_joined: tuple[tuple[int, str], ...]
    refused: Mapping[tuple[int, int, str], int]
    loops: int
    merges: int
    cost_before: float
    cost_after: float


def _select(
    atlas: Atlas, proposals: LoopProposals, options: MergeOptions
) -> tuple[list[LoopClosure], Refused]:
    """Return the links that agree, for each pair of maps, and the reasons for refusing the others."""
    refused = Counter(proposals.failed)
    groups: dict[tuple[int, int], list[LoopClosure]] = {}
    for link in proposals.links:
        groups.setdefault(maps_of(atlas, link.a, link.b), []).append(link)
    accepted: list[LoopClosure] = []
    for pair, links in sorted(groups.items()):
        rows, reasons = agreeing_links(pair, links, atlas.T_world_camera, atlas.order, options)
        accepted += [links[row] for row in rows]
        refused.update(reasons)
    return accepted, Counter({key: count for key, count in refused.items() if count})


def _no_alignments(atlas: Atlas, placed: Array, links: Sequence[LoopClosure]) -> list[LoopClosure]:
    return []


def _optimise(graph: PoseGraph, of_map: npt.NDArray[np.int64], options: OptimiseOptions) -> OptimisedGraph:
    return optimise_graph(graph, options)


def _deform(
    versions: Sequence[MapVersion], atlas: Atlas, poses: Array, rows: npt.NDArray[np.int64]
) -> tuple[Points, Colours]:
    return deform_clouds(versions, atlas.of_map, atlas.keyframes, poses, rows)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeSteps:
    """The steps of a merge that take long; `rse_pf.batch` runs them in several processes.

    Attributes:
        propose: Returns measured links.
        select: Returns the links that agree, and how many were refused by maps and reason.
        align: Returns further links, found by aligning clouds with all maps at their ``(n, 4, 4)`` places.
        optimise: Returns the poses of the graph; its second argument is the map of each pose.
        deform: Returns the cloud of the maps of ``rows`` for the new ``(n, 4, 4)`` poses.
    """

    propose: Callable[[Atlas, MergeOptions, Report], LoopProposals] = propose_links
    select: Callable[[Atlas, LoopProposals, MergeOptions], tuple[list[LoopClosure], Refused]] = field(
        default=_select
    )
    align: Callable[[Atlas, Array, Sequence[LoopClosure]], list[LoopClosure]] = _no_alignments
    optimise: Callable[[PoseGraph, npt.NDArray[np.int64], OptimiseOptions], OptimisedGraph] = _optimise
    deform: Callable[[Sequence[MapVersion], Atlas, Array, npt.NDArray[np.int64]], tuple[Points, Colours]] = (
        _deform
    )


def merge_versions(
    versions: Sequence[MapVersion],
    options: MergeOptions | None = None,
    *,
    report: Report = ignore_progress,
    propose: Callable[[Atlas, MergeOptions, Report], LoopProposals] | None = None,
    steps: MergeSteps | None = None,
) -> MergedMap:
    """Merge *versions* into one map in the world frame of the first.

    Args:
        versions: Maps with at least one keyframe each.
        options: ``None`` means the defaults.
        report: Called with the progress; may raise Cancelled.
        propose: Proposes links; None means the first of *steps*.
        steps: The steps that take long; None means the functions of this package, in this process.

    Raises:
        MissingExtra: gtsam or the native core is not installed.
        Cancelled: *report* raised it.
    """
    options = options or MergeOptions()
    atlas = Atlas.of(versions)
    steps = steps or MergeSteps()
    proposals = (propose or steps.propose)(atlas, options, report)
    accepted, refused = steps.select(atlas, proposals, options)
    report(0.8, f"{len(accepted)} of {len(proposals.links)} links agree")
    placed, joined = _place(atlas, accepted, len(versions))
    kept = [link for link in accepted if {int(atlas.of_map[link.a]), int(atlas.of_map[link.b])} <= joined]
    rows = np.flatnonzero(np.isin(atlas.of_map, sorted(joined)))
    odometry = _odometry(atlas, versions, joined)
    kept += steps.align(atlas, placed, kept)
    graph = _graph(atlas, placed, rows, odometry, kept)
    found = steps.optimise(graph, atlas.of_map[rows], OptimiseOptions(cauchy=options.cauchy))
    report(0.95, "optimised")
    poses = placed.copy()
    poses[rows] = found.T_world_pose
    points, colours = steps.deform(versions, atlas, poses, rows)
    version = _version(atlas, versions, poses, rows, odometry, kept, points, colours)
    report(1.0, "merged")
    merges = sum(atlas.of_map[link.a] != atlas.of_map[link.b] for link in kept)
    return MergedMap(
        version=version,
        joined=tuple(sorted(joined)),
        not_joined=tuple(
            (which, _reason_not_joined(which, joined, proposals, refused, options))
            for which in range(len(versions)) if which not in joined
        ),
        refused=refused,
        loops=len(kept) - int(merges),
        merges=int(merges),
        cost_before=found.cost_before,
        cost_after=found.cost_after,
    )  # fmt: skip


def _place(atlas: Atlas, links: Sequence[LoopClosure], maps: int) -> tuple[Array, set[int]]:
    """Transform every map that is connected to map 0 into its world frame, pairs with most links first.

    The pose of a map is the median of those that the links of a pair propose: the one that differs least
    from the others, so that rotations need no average.
    """
    placed = atlas.T_world_camera.copy()
    joined = {0}
    groups: dict[tuple[int, int], list[LoopClosure]] = {}
    for link in links:
        one, other = maps_of(atlas, link.a, link.b)
        if one != other:
            groups.setdefault((one, other), []).append(link)
    while True:
        open_pairs = [pair for pair in groups if len(joined & set(pair)) == 1]
        if not open_pairs:
            return placed, joined
        pair = max(open_pairs, key=lambda each: (len(groups[each]), (-each[0], -each[1])))
        new = pair[0] if pair[1] in joined else pair[1]
        T_world_new = median_pose(
            np.array([_proposed(atlas, placed, link, new) for link in groups[pair]])
        )  # fmt: skip
        rows = atlas.of_map == new
        placed[rows] = T_world_new @ atlas.T_world_camera[rows]
        joined.add(new)


def _proposed(atlas: Atlas, placed: Array, link: LoopClosure, new: int) -> Array:
    old, other, T_old_other = link.a, link.b, link.T_a_b
    if atlas.of_map[link.a] == new:
        old, other, T_old_other = link.b, link.a, inverse(link.T_a_b)
    T_world_new: Array = placed[old] @ T_old_other @ inverse(atlas.T_world_camera[other])
    return T_world_new


def _odometry(
    atlas: Atlas, versions: Sequence[MapVersion], joined: set[int]
) -> list[tuple[LoopClosure, str]]:
    """Return the edges of the maps; consecutive keyframes without one get their relative pose."""
    edges: list[tuple[LoopClosure, str]] = []
    known: set[tuple[int, int]] = set()
    for which in sorted(joined):
        _check_information(which, versions[which])
        for edge in versions[which].edges:
            a, b = atlas.row_of[which, edge.a], atlas.row_of[which, edge.b]
            edges.append((LoopClosure(a=a, b=b, T_a_b=edge.T_a_b, information=edge.information), edge.kind))
            known.add((min(a, b), max(a, b)))
    spread = np.array([_DRIFT.step_m] * 3 + [math.radians(_DRIFT.step_deg)] * 3)
    for a in range(len(atlas.keyframes) - 1):
        b = a + 1
        same = atlas.of_map[a] == atlas.of_map[b] and atlas.keyframes[a].robot == atlas.keyframes[b].robot
        if same and int(atlas.of_map[a]) in joined and (a, b) not in known:
            T_a_b = inverse(atlas.T_world_camera[a]) @ atlas.T_world_camera[b]
            edges.append((LoopClosure(a=a, b=b, T_a_b=T_a_b, information=np.diag(spread**-2.0)), "odometry"))
    return edges


def _check_information(which: int, version: MapVersion) -> None:
    """Name the map whose edges cannot be optimised; raises BadRequest."""
    every = np.array([edge.information for edge in version.edges]).reshape(-1, 6, 6)
    if is_positive_definite(every):
        return
    edge = next(edge for edge in version.edges if not is_positive_definite(edge.information[None]))
    raise BadRequest(
        f"map {which} (the first is 0): the information of edge {edge.a}-{edge.b} is not symmetric and "
        "positive definite",
        hint="leave that map out",
    )


def _graph(
    atlas: Atlas,
    placed: Array,
    rows: npt.NDArray[np.int64],
    odometry: Sequence[tuple[LoopClosure, str]],
    links: Sequence[LoopClosure],
) -> PoseGraph:
    place = np.full(len(atlas.keyframes), -1)
    place[rows] = np.arange(len(rows))
    every = [link for link, _ in odometry] + list(links)
    return PoseGraph(
        T_world_pose=placed[rows],
        a=place[np.array([link.a for link in every], dtype=np.int64)],
        b=place[np.array([link.b for link in every], dtype=np.int64)],
        T_a_b=np.array([link.T_a_b for link in every]).reshape(-1, 4, 4),
        information=np.array([link.information for link in every]).reshape(-1, 6, 6),
        robust=np.array([kind != "odometry" for _, kind in odometry] + [True] * len(links), dtype=np.bool_),
        ids=np.arange(len(rows)),
    )


def _version(
    atlas: Atlas,
    versions: Sequence[MapVersion],
    poses: Array,
    rows: npt.NDArray[np.int64],
    odometry: Sequence[tuple[LoopClosure, str]],
    links: Sequence[LoopClosure],
    points: Points,
    colours: Colours,
) -> MapVersion:
    """Return the merged map; ids are row numbers, the provenance has the original map and id of each."""
    place = {int(row): number for number, row in enumerate(rows)}
    keyframes = tuple(
        replace(atlas.keyframes[row], id=place[row], T_world_camera=poses[row]) for row in place
    )
    edges = [(link, kind) for link, kind in odometry]
    edges += [(link, "loop" if atlas.of_map[link.a] == atlas.of_map[link.b] else "merge") for link in links]
    return MapVersion(
        keyframes=keyframes,
        edges=tuple(
            Edge(
                a=place[link.a],
                b=place[link.b],
                T_a_b=link.T_a_b,
                information=link.information,
                kind="odometry" if kind == "odometry" else "loop" if kind == "loop" else "merge",
            )
            for link, kind in edges
        ),
        points=points,
        colours=colours,
        provenance=_provenance(
            versions,
            [[int(atlas.of_map[row]), atlas.keyframes[row].id] for row in place],
            versions[int(atlas.of_map[rows[0]])].up,
        ),
    )


def _provenance(versions: Sequence[MapVersion], origins: list[list[int]], up: Array | None) -> dict[str, Any]:
    """Return the provenance with those of *versions*, whose own parents are left out where it is too long.

    *up* is that of the map whose world is kept.
    """
    known: dict[str, Any] = {} if up is None else {UP_FIELD: up.tolist()}
    whole: list[Mapping[str, Any]] = [dict(version.provenance) for version in versions]
    short = [{name: each[name] for name in each if name != "parents"} for each in whole]
    for parents in (whole, short):
        provenance = {"made_by": "merge", "from": origins, **known, "parents": parents}
        encoded = msgspec.msgpack.encode(provenance)
        try:
            check_msgpack(encoded, PROVENANCE)
        except LimitExceeded:
            continue
        if len(encoded) <= PROVENANCE.wire_bytes:
            return provenance
    return {"made_by": "merge", "from": origins, **known}


def _reason_not_joined(
    which: int,
    joined: set[int],
    proposals: LoopProposals,
    refused: Mapping[tuple[int, int, str], int],
    options: MergeOptions,
) -> str:
    tried: Counter[str] = Counter()
    for (one, other, reason), count in refused.items():
        if which in (one, other) and one != other:
            tried[reason] += count
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(tried.items()) if count)
    return (
        f"fewer than {options.min_links} views shared with maps {sorted(joined)} agree "
        f"({reasons or 'no candidates'})"
    )
