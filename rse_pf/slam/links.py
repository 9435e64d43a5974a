"""Links between keyframes of maps: propose pairs by place recognition, measure them, keep those that agree.

Each function works on the keyframes that it is given, so that a pair of maps can be computed alone, in any
process, with the same result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import Array, inverse
from rse_pf.maps.descriptors import common_kind
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.service import Report
from rse_pf.slam.consistency import LinkEnds, LoopClosure, OdometryNoise, consistent, fits_prediction
from rse_pf.slam.optimise import ignore_progress
from rse_pf.slam.place_recognition import PlaceIndex, place_vector
from rse_pf.slam.relative_pose import (
    RelativePoseOptions,
    landmarks_of_keyframe,
    measure_relative_pose,
    view_of_keyframe,
)

__all__ = [
    "Atlas",
    "LoopProposals",
    "MergeOptions",
    "Refused",
    "agreeing_links",
    "candidate_pairs",
    "maps_of",
    "measure_pairs",
    "propose_links",
]

Refused = Counter[tuple[int, int, str]]
"""Number of keyframe pairs by map, other map and reason."""

_MAX_PAIRS = 700_000
"""Keyframe pairs that may be tried; each takes some milliseconds."""
_WEAK_VARIANCE = 4.0
"""In rendered worlds the errors of weak poses are 1.2 to 1.7 times, at most 2.7 times, their deviations.

A merge takes them, as it sees all links at once: a third of the links between two maps are weak.
"""
_MIN_LOOP_LENGTH = 3
"""Keyframes of one robot that are closer than this along its trajectory are not a loop."""


class MergeOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How to merge.

    ``candidates`` other keyframes are tried for each keyframe and each map; two maps are joined by
    ``min_links`` loops that agree with each other, or not at all; ``close_loops`` also looks for loops
    within each map.

    Raises:
        BadRequest: A number is out of its range.
    """

    candidates: int = 8
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
        """Return the atlas of *versions*, keyframes by map, robot and time.

        Raises:
            BadRequest: They have features of two kinds.
        """
        common_kind((version.kind for version in versions if version.keyframes), "the first map")
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
    index = PlaceIndex.from_vectors(place_vector(keyframe.descriptors) for keyframe in atlas.keyframes)
    pairs = candidate_pairs(index, atlas.of_map, atlas.order, options)
    links, failed = measure_pairs(
        atlas, pairs, options, lambda done, what: report(0.1 + 0.7 * done, what)
    )  # fmt: skip
    return LoopProposals(links=tuple(links), failed=failed)


def candidate_pairs(
    index: PlaceIndex,
    of_map: npt.NDArray[np.int64],
    order: npt.NDArray[np.int64],
    options: MergeOptions,
    *,
    between: tuple[int, int] | None = None,
) -> list[tuple[int, int]]:
    """Return the pairs of rows, lower row first and sorted, that may show the same place.

    Args:
        index: The vectors of the keyframes.
        of_map: ``(n,)``, the map of each keyframe.
        order: ``(n,)``, its index along the trajectory of its robot.
        options: How many candidates, and whether pairs within a map are wanted.
        between: Only pairs of these two maps, or of the one map that stands there twice.
    """
    pairs: set[tuple[int, int]] = set()
    every = np.arange(len(of_map))
    maps = np.unique(of_map).tolist()
    for a in range(len(of_map)):
        for which in maps:
            own = which == of_map[a]
            if own and not options.close_loops:
                continue
            if between is not None and {int(of_map[a]), which} != set(between):
                continue
            allowed = every[of_map == which]
            if own:
                allowed = allowed[np.abs(order[allowed] - order[a]) >= _MIN_LOOP_LENGTH]
            for b, _ in index.nearest(index.vector_of(a), options.candidates, allowed):
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def measure_pairs(
    atlas: Atlas,
    pairs: Sequence[tuple[int, int]],
    options: MergeOptions,
    report: Report = ignore_progress,
) -> tuple[list[LoopClosure], Refused]:
    """Return the links of *pairs* of rows that PnP could measure, in their order, and why others failed."""
    pose_options = RelativePoseOptions(
        min_inliers=options.min_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
        weak_variance=_WEAK_VARIANCE,
    )
    links: list[LoopClosure] = []
    failed: Refused = Counter()
    for done, (a, b) in enumerate(pairs):
        if done % 16 == 0:
            report(done / len(pairs), f"{done} of {len(pairs)} keyframe pairs")
        measured = measure_relative_pose(
            landmarks_of_keyframe(atlas.keyframes[a]), view_of_keyframe(atlas.keyframes[b]), pose_options
        )  # fmt: skip
        if isinstance(measured, str):
            one, other = maps_of(atlas, a, b)
            failed[one, other, measured] += 1
        else:
            links.append(
                LoopClosure(
                    a=a, b=b, T_a_b=measured.T_a_b, information=measured.information,
                    inliers=measured.inliers, matches=measured.matches,
                )
            )  # fmt: skip
    return links, failed


def agreeing_links(
    maps: tuple[int, int],
    links: Sequence[LoopClosure],
    T_world_camera: Array,
    order: npt.NDArray[np.int64],
    options: MergeOptions,
) -> tuple[list[int], Refused]:
    """Return which of *links*, all between two *maps* or within one, agree, and why others are refused.

    Args:
        maps: The two maps, or one twice.
        links: Rows are those of the two arrays.
        T_world_camera: ``(n, 4, 4)``, each map in its own world.
        order: ``(n,)``, index along a trajectory.
        options: How many must agree.
    """
    one, other = maps
    refused: Refused = Counter()
    noise = OdometryNoise()
    chosen = list(range(len(links)))
    if one == other:
        # Within one map a loop must also agree with the odometry.
        chosen = _fits_odometry(T_world_camera, order, links, noise)
        refused[one, other, "against-odometry"] += len(links) - len(chosen)
    rows = consistent([links[row] for row in chosen], T_world_camera, order, noise)
    if one != other and len(rows) < options.min_links:
        refused[one, other, "too-few-agree"] += len(links)
        return [], refused
    refused[one, other, "inconsistent"] += len(chosen) - len(rows)
    return [chosen[row] for row in rows.tolist()], refused


def maps_of(atlas: Atlas, a: int, b: int) -> tuple[int, int]:
    """Return the maps of two rows, the lower first."""
    one, other = int(atlas.of_map[a]), int(atlas.of_map[b])
    return min(one, other), max(one, other)


def _fits_odometry(
    T_world_camera: Array, order: npt.NDArray[np.int64], links: Sequence[LoopClosure], noise: OdometryNoise
) -> list[int]:
    """Return the rows of the loops that differ from odometry by no more than its drift."""
    if not links:
        return []
    ends = LinkEnds.of(links)
    predicted = inverse(T_world_camera[ends.a]) @ T_world_camera[ends.b]
    walked = np.abs(order[ends.a] - order[ends.b]).astype(np.float64)
    lever_m = np.array([_lever_m(T_world_camera, link) for link in links])
    fits = fits_prediction(predicted, ends, walked, lever_m, noise)
    return [int(row) for row in np.flatnonzero(fits)]


def _lever_m(T_world_camera: Array, link: LoopClosure) -> float:
    """Return the largest distance of the path between a link's ends from its end: the lever of rotations."""
    low, high = sorted((link.a, link.b))
    way = T_world_camera[low : high + 1, :3, 3]
    return float(np.linalg.norm(way - way[-1], axis=1).max())
