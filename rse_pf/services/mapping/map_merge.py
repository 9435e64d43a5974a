"""Merge maps: propose loop closures, select consistent ones, align the maps, optimise, deform the clouds.

A pure function of the maps and the options; `merge` is the service.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.budget import PROVENANCE, check_msgpack
from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array, inverse
from rse_pf.maps.format import Edge, Keyframe, MapVersion
from rse_pf.service import Report
from rse_pf.services.mapping.cloud_deform import deform_clouds
from rse_pf.services.mapping.loop_consistency import LoopClosure, OdometryNoise, consistent
from rse_pf.services.mapping.optimise import OptimiseOptions, ignore_progress, optimise_graph
from rse_pf.services.mapping.place import PlaceIndex
from rse_pf.services.mapping.pose_graph import PoseGraph
from rse_pf.services.mapping.relative_pose import RelativePoseOptions, measure_relative_pose

__all__ = ["Atlas", "LoopProposals", "MergeOptions", "MergedMap", "merge_versions", "propose_links"]

_MAX_PAIRS = 500_000
"""Keyframe pairs that may be tried; each takes some milliseconds."""
_MIN_LOOP_LENGTH = 3
"""Keyframes of one robot that are closer than this along its trajectory are not a loop."""
_DRIFT = OdometryNoise(step_m=0.007, step_deg=0.5)
"""The drift of a tracker with depth; whether a loop may be true is judged by the larger default."""


class MergeOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to merge.

    ``candidates`` other keyframes are tried for each keyframe and each map; two maps are joined by
    ``min_links`` loops that agree with each other, or not at all; ``close_loops`` also looks for loops
    within each map.

    Raises:
        BadRequest: A number is out of its range.
    """

    candidates: int = 6
    min_inliers: int = 40
    min_inlier_ratio: float = 0.5
    min_links: int = 3
    close_loops: bool = True
    cauchy: float = 3.0

    def __post_init__(self) -> None:
        within = (
            1 <= self.candidates <= 100 and self.min_inliers >= 12 and 0 < self.min_inlier_ratio <= 1
            and self.min_links >= 1 and self.cauchy >= 0
        )  # fmt: skip
        if not within:
            raise BadRequest("an option of merge is out of its range", hint="leave it out for the default")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atlas:
    """The keyframes of all maps in one list, each map in its own world frame."""

    keyframes: tuple[Keyframe, ...]
    of_map: npt.NDArray[np.int64]
    """``(n,)``: the map of each keyframe."""
    order: npt.NDArray[np.int64]
    """``(n,)``: index of each keyframe along the trajectory of its robot."""
    T_world_camera: Array
    """``(n, 4, 4)``."""
    row_of: Mapping[tuple[int, int], int]
    """Row of (map, id)."""

    @classmethod
    def of(cls, versions: Sequence[MapVersion]) -> Atlas:
        """Return the atlas of *versions*, keyframes by map, robot and time."""
        rows = [
            (which, keyframe)
            for which, version in enumerate(versions)
            for keyframe in sorted(version.keyframes, key=lambda k: (k.robot, k.timestamp_s, k.id))
        ]
        return cls(
            keyframes=tuple(keyframe for _, keyframe in rows),
            of_map=np.array([which for which, _ in rows], dtype=np.int64),
            order=np.arange(len(rows), dtype=np.int64),
            T_world_camera=np.array([k.T_world_camera for _, k in rows], dtype=np.float64),
            row_of={(which, k.id): row for row, (which, k) in enumerate(rows)},
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopProposals:
    """Links that PnP measured, and the number of keyframe pairs of two maps that failed, by reason."""

    links: tuple[LoopClosure, ...]
    failed: Counter[tuple[int, int, str]]


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


def merge_versions(
    versions: Sequence[MapVersion],
    options: MergeOptions | None = None,
    *,
    report: Report = ignore_progress,
    propose: Callable[[Atlas, MergeOptions, Report], LoopProposals] | None = None,
) -> MergedMap:
    """Merge *versions* into one map in the world frame of the first.

    Args:
        versions: Maps with at least one keyframe each.
        options: ``None`` means the defaults.
        report: Called with the progress; may raise Cancelled.
        propose: Proposes links; None means `propose_links`.

    Raises:
        MissingExtra: faiss, gtsam or a solver is not installed.
        Cancelled: *report* raised it.
    """
    options = options or MergeOptions()
    atlas = Atlas.of(versions)
    proposals = (propose or propose_links)(atlas, options, report)
    accepted, refused = _select_consistent(atlas, proposals, options)
    report(0.8, f"{len(accepted)} of {len(proposals.links)} links agree")
    placed, joined = _place(atlas, accepted, len(versions))
    kept = [link for link in accepted if {int(atlas.of_map[link.a]), int(atlas.of_map[link.b])} <= joined]
    rows = np.flatnonzero(np.isin(atlas.of_map, sorted(joined)))
    odometry = _odometry(atlas, versions, joined)
    graph = _graph(atlas, placed, rows, odometry, kept)
    found = optimise_graph(graph, OptimiseOptions(cauchy=options.cauchy))
    report(0.95, "optimised")
    poses = placed.copy()
    poses[rows] = found.T_world_pose
    version = _version(atlas, versions, poses, rows, odometry, kept)
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


def propose_links(atlas: Atlas, options: MergeOptions, report: Report = ignore_progress) -> LoopProposals:
    """Measure the relative poses of keyframes that place recognition considers the same place.

    Raises:
        LimitExceeded: There may be more pairs than can be measured.
    """
    most = len(atlas.keyframes) * (int(atlas.of_map.max()) + 1) * options.candidates
    if most > _MAX_PAIRS:
        raise LimitExceeded(
            f"up to {most} pairs of keyframes are above {_MAX_PAIRS}",
            hint="merge fewer maps at once, or ask for fewer candidates",
        )
    index = PlaceIndex(atlas.keyframes)
    pairs = _candidate_pairs(atlas, index, options)
    pose_options = RelativePoseOptions(
        min_inliers=options.min_inliers, min_inlier_ratio=options.min_inlier_ratio
    )
    links: list[LoopClosure] = []
    failed: Counter[tuple[int, int, str]] = Counter()
    for done, (a, b) in enumerate(pairs):
        if done % 16 == 0:
            report(0.1 + 0.7 * done / len(pairs), f"{done} of {len(pairs)} keyframe pairs")
        measured = measure_relative_pose(atlas.keyframes[a], atlas.keyframes[b], pose_options)
        if isinstance(measured, str):
            one, other = _pair(atlas, a, b)
            failed[one, other, measured] += 1
        else:
            links.append(
                LoopClosure(
                    a=a, b=b, T_a_b=measured.T_a_b, information=measured.information,
                    inliers=measured.inliers, matches=measured.matches,
                )
            )  # fmt: skip
    return LoopProposals(links=tuple(links), failed=failed)


def _candidate_pairs(atlas: Atlas, index: PlaceIndex, options: MergeOptions) -> list[tuple[int, int]]:
    pairs: set[tuple[int, int]] = set()
    every = np.arange(len(atlas.keyframes))
    for a in range(len(atlas.keyframes)):
        for which in np.unique(atlas.of_map).tolist():
            own = which == atlas.of_map[a]
            if own and not options.close_loops:
                continue
            allowed = every[atlas.of_map == which]
            if own:
                allowed = allowed[np.abs(atlas.order[allowed] - atlas.order[a]) >= _MIN_LOOP_LENGTH]
            for b, _ in index.nearest_to(index.vector(a), options.candidates, allowed):
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def _select_consistent(
    atlas: Atlas, proposals: LoopProposals, options: MergeOptions
) -> tuple[list[LoopClosure], Counter[tuple[int, int, str]]]:
    """Return the links that agree, for each pair of maps, and the reasons for refusing the others."""
    refused = Counter(proposals.failed)
    groups: dict[tuple[int, int], list[LoopClosure]] = {}
    for link in proposals.links:
        groups.setdefault(_pair(atlas, link.a, link.b), []).append(link)
    accepted: list[LoopClosure] = []
    noise = OdometryNoise()
    for (one, other), links in sorted(groups.items()):
        if one == other:
            # Within one map a loop must also agree with the odometry.
            links = [link for link in links if _fits_odometry(atlas, link, noise)]
            refused[one, other, "against-odometry"] += len(groups[one, other]) - len(links)
        rows = consistent(links, atlas.T_world_camera, atlas.order, noise)
        if one != other and len(rows) < options.min_links:
            refused[one, other, "too-few-agree"] += len(links)
            continue
        accepted += [links[row] for row in rows]
        refused[one, other, "inconsistent"] += len(links) - len(rows)
    return accepted, Counter({key: count for key, count in refused.items() if count})


def _fits_odometry(atlas: Atlas, link: LoopClosure, noise: OdometryNoise) -> bool:
    """Return whether a loop differs from odometry by at most three sigma of its drift."""
    predicted = inverse(atlas.T_world_camera[link.a]) @ atlas.T_world_camera[link.b]
    off = inverse(link.T_a_b) @ predicted
    walked = abs(int(atlas.order[link.a] - atlas.order[link.b])) + 2
    rad = 3.0 * math.sqrt(3.0 * walked) * math.radians(noise.step_deg)
    metres = 3.0 * math.sqrt(3.0 * walked) * noise.step_m + rad * _lever_m(atlas, link)
    turned = math.acos(min(1.0, max(-1.0, (np.trace(off[:3, :3]) - 1.0) / 2.0)))
    return bool(np.linalg.norm(off[:3, 3]) <= metres and turned <= rad)


def _lever_m(atlas: Atlas, link: LoopClosure) -> float:
    """Return the largest distance of the path between a link's ends from its end: the lever of rotations."""
    low, high = sorted((link.a, link.b))
    way = atlas.T_world_camera[low : high + 1, :3, 3]
    return float(np.linalg.norm(way - way[-1], axis=1).max())


def _place(atlas: Atlas, links: Sequence[LoopClosure], maps: int) -> tuple[Array, set[int]]:
    """Transform every map that is connected to map 0 into its world frame, pairs with most links first.

    The pose of a map is the median of those that the links of a pair propose: the one that differs least
    from the others, so that rotations need no average.
    """
    placed = atlas.T_world_camera.copy()
    joined = {0}
    groups: dict[tuple[int, int], list[LoopClosure]] = {}
    for link in links:
        one, other = _pair(atlas, link.a, link.b)
        if one != other:
            groups.setdefault((one, other), []).append(link)
    while True:
        open_pairs = [pair for pair in groups if len(joined & set(pair)) == 1]
        if not open_pairs:
            return placed, joined
        pair = max(open_pairs, key=lambda each: (len(groups[each]), (-each[0], -each[1])))
        new = pair[0] if pair[1] in joined else pair[1]
        T_world_new = _median_pose(
            [_proposed(atlas, placed, link, new) for link in groups[pair]]
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


def _median_pose(poses: list[Array]) -> Array:
    stack = np.array(poses)
    apart_m = np.linalg.norm(stack[:, None, :3, 3] - stack[None, :, :3, 3], axis=2)
    turned = np.linalg.norm(stack[:, None, :3, :3] - stack[None, :, :3, :3], axis=(2, 3))
    return poses[int(np.argmin((apart_m + turned).sum(axis=1)))]


def _odometry(
    atlas: Atlas, versions: Sequence[MapVersion], joined: set[int]
) -> list[tuple[LoopClosure, str]]:
    """Return the edges of the maps; consecutive keyframes without one get their relative pose."""
    edges: list[tuple[LoopClosure, str]] = []
    known: set[tuple[int, int]] = set()
    for which in sorted(joined):
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
) -> MapVersion:
    """Return the merged map; ids are row numbers, the provenance has the original map and id of each."""
    place = {int(row): number for number, row in enumerate(rows)}
    keyframes = tuple(
        replace(atlas.keyframes[row], id=place[row], T_world_camera=poses[row]) for row in place
    )
    edges = [(link, kind) for link, kind in odometry]
    edges += [(link, "loop" if atlas.of_map[link.a] == atlas.of_map[link.b] else "merge") for link in links]
    points, colours = deform_clouds(versions, atlas.of_map, atlas.keyframes, poses, rows)
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
            versions, [[int(atlas.of_map[row]), atlas.keyframes[row].id] for row in place]
        ),
    )


def _provenance(versions: Sequence[MapVersion], origins: list[list[int]]) -> dict[str, Any]:
    """Return the provenance with those of *versions*, whose own parents are left out where it is too long."""
    whole: list[Mapping[str, Any]] = [dict(version.provenance) for version in versions]
    short = [{name: each[name] for name in each if name != "parents"} for each in whole]
    for parents in (whole, short):
        provenance = {"made_by": "merge", "from": origins, "parents": parents}
        encoded = msgspec.msgpack.encode(provenance)
        try:
            check_msgpack(encoded, PROVENANCE)
        except LimitExceeded:
            continue
        if len(encoded) <= PROVENANCE.wire_bytes:
            return provenance
    return {"made_by": "merge", "from": origins}


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


def _pair(atlas: Atlas, a: int, b: int) -> tuple[int, int]:
    one, other = int(atlas.of_map[a]), int(atlas.of_map[b])
    return min(one, other), max(one, other)
