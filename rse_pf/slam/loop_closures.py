"""Find loop closures between keyframes of stored maps: propose pairs, measure them, keep those that agree.

Each function works on the keyframes that it is given, so that one pair of maps can be computed alone, in any
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
from rse_pf.slam.consistency import (
    EdgeArrays,
    LoopClosure,
    OdometryNoise,
    find_consistent_set,
    fits_prediction,
)
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
    "RejectionCounts",
    "choose_candidate_pairs",
    "map_pair_of",
    "measure_pairs",
    "propose_loop_closures",
    "select_consistent",
]

RejectionCounts = Counter[tuple[int, int, str]]
"""Number of rejected keyframe pairs by the indices of their two maps, the smaller one first, and the
reason."""

MAX_PAIRS = 700_000
"""Largest product of the number of keyframes, the number of maps and `MergeOptions.candidates`.  It bounds
the number of pairs of keyframes that a merge compares, each for some milliseconds; a merge with a larger
product is refused."""
WEAK_POSE_VARIANCE = 4.0
"""Factor by which the covariance of a relative pose that PnP calls weak is multiplied; standard deviations
become twice as large.  In rendered worlds the errors of such poses were typically 1.2 to 1.7 times, and at
most 2.7 times, the unmultiplied standard deviations.  Weak poses are used because they are a third of the
loop closures between two maps."""
MIN_LOOP_KEYFRAMES = 3  # smallest difference of the rows of both ends of a loop within one map
PAIRS_PER_REPORT = 16  # keyframe pairs between two reports of progress


class MergeOptions(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of a merge of stored maps.

    Attributes:
        candidates: Keyframes of each map that place recognition proposes for each keyframe, within 1 to 100.
        min_inliers: Inliers that a loop closure needs, at least 12.
        min_inlier_ratio: Inliers per match that a loop closure needs, above 0 and at most 1.
        min_links: Loop closures that must agree pairwise to join two maps; with fewer, none is accepted.
        close_loops: Whether to look for loop closures within each map as well.
        cauchy: Width of the robust Cauchy kernel on loop closures, in standard deviations; 0 for none.

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
        is_valid = (
            1 <= self.candidates <= 100
            and self.min_inliers >= 12
            and 0 < self.min_inlier_ratio <= 1
            and self.min_links >= 1
            and self.cauchy >= 0
        )
        if not is_valid:
            raise BadRequest(
                "an option of merge is out of its range: candidates 1..100, min_inliers from 12, "
                "min_inlier_ratio above 0 and up to 1, min_links from 1, cauchy from 0",
                hint="leave the option out for its default",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atlas:
    """The keyframes of several maps in one list, by map, robot and time.

    Attributes:
        keyframes: All *n* keyframes.  The difference of two rows of one map counts as the number of odometry
            steps between the keyframes.  For keyframes of two robots this is an approximation, since no
            odometry connects the last keyframe of one robot with the first one of the next.
        of_map: ``(n,)``, the map of each keyframe.
        T_world_camera: ``(n, 4, 4)``, each pose in the world frame of its own map, metres.
        row_of: Row of each keyframe by (map, id).
    """

    keyframes: tuple[Keyframe, ...]
    of_map: npt.NDArray[np.int64]
    T_world_camera: Array
    row_of: Mapping[tuple[int, int], int]

    @classmethod
    def of(cls, versions: Sequence[MapVersion]) -> Atlas:
        """Return the atlas of *versions*; a map is named by its index in *versions*.

        Raises:
            BadRequest: The maps have descriptors of two kinds.
        """
        common_kind((version.kind for version in versions if version.keyframes), "the first map")
        rows = [
            (map_index, keyframe)
            for map_index, version in enumerate(versions)
            for keyframe in sorted(version.keyframes, key=lambda k: (k.robot, k.timestamp_s, k.id))
        ]
        return cls(
            keyframes=tuple(keyframe for _, keyframe in rows),
            of_map=np.array([map_index for map_index, _ in rows], dtype=np.int64),
            T_world_camera=np.array([keyframe.T_world_camera for _, keyframe in rows], dtype=np.float64),
            row_of={(map_index, keyframe.id): row for row, (map_index, keyframe) in enumerate(rows)},
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopProposals:
    """The measured loop closures, and why other proposed pairs of keyframes gave none.

    Attributes:
        loop_closures: The measured loop closures.
        failed: The number of pairs that could not be measured, by maps and reason.
    """

    loop_closures: tuple[LoopClosure, ...]
    failed: RejectionCounts


def propose_loop_closures(
    atlas: Atlas, options: MergeOptions, report: Report = ignore_progress
) -> LoopProposals:
    """Measure the relative poses of keyframes that place recognition proposes as the same place.

    Args:
        atlas: The keyframes of all maps, at least one.
        options: How many candidates are compared, and what a loop closure needs.
        report: Receives the progress within 0.1 to 0.8, and a text.

    Raises:
        LimitExceeded: There may be more keyframe pairs than can be compared.
    """
    pair_limit = len(atlas.keyframes) * (int(atlas.of_map.max()) + 1) * options.candidates
    if pair_limit > MAX_PAIRS:
        raise LimitExceeded(
            f"up to {pair_limit} pairs of keyframes are above {MAX_PAIRS}",
            hint="merge fewer maps at once, or ask for fewer candidates",
        )
    index = PlaceIndex.from_pairs(
        (row, place_vector(keyframe.descriptors)) for row, keyframe in enumerate(atlas.keyframes)
    )
    pairs = choose_candidate_pairs(index, atlas.of_map, options)
    loop_closures, failed = measure_pairs(
        atlas, pairs, options, lambda progress, text: report(0.1 + 0.7 * progress, text)
    )
    return LoopProposals(loop_closures=tuple(loop_closures), failed=failed)


def choose_candidate_pairs(
    index: PlaceIndex,
    of_map: npt.NDArray[np.int64],
    options: MergeOptions,
    *,
    between: tuple[int, int] | None = None,
) -> list[tuple[int, int]]:
    """Return the pairs of rows that may show the same place, the lower row first, sorted.

    Args:
        index: Place recognition vectors of all keyframes, by row.
        of_map: ``(n,)``, the map of each keyframe; keyframes of one map are paired if their rows differ by 3
            or more.
        options: How many candidates are chosen, and whether pairs within one map are.
        between: Two maps, or one map twice, if only pairs between them are wanted.
    """
    pairs: set[tuple[int, int]] = set()
    rows = np.arange(len(of_map))
    maps = np.unique(of_map).tolist()
    for a in range(len(of_map)):
        for map_index in maps:
            is_same_map = map_index == of_map[a]
            if is_same_map and not options.close_loops:
                continue
            if between is not None and {int(of_map[a]), map_index} != set(between):
                continue
            allowed = rows[of_map == map_index]
            if is_same_map:
                allowed = allowed[np.abs(allowed - a) >= MIN_LOOP_KEYFRAMES]
            for b, _ in index.nearest(index.vector_of(a), options.candidates, allowed):
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def measure_pairs(
    atlas: Atlas,
    pairs: Sequence[tuple[int, int]],
    options: MergeOptions,
    report: Report = ignore_progress,
) -> tuple[list[LoopClosure], RejectionCounts]:
    """Return the loop closures of those *pairs* of rows that PnP can measure, and count the other pairs.

    The other pairs are counted by their maps and the reason why no relative pose was measured.
    The landmarks of the first keyframe of a pair are matched with the image of the second.  *report* receives
    the progress within 0 to 1, and a text.
    """
    pose_options = RelativePoseOptions(
        min_inliers=options.min_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
        weak_variance=WEAK_POSE_VARIANCE,
    )
    loop_closures: list[LoopClosure] = []
    failed: RejectionCounts = Counter()
    for done, (a, b) in enumerate(pairs):
        if done % PAIRS_PER_REPORT == 0:
            report(done / len(pairs), f"{done} of {len(pairs)} keyframe pairs")
        measured = measure_relative_pose(
            landmarks_of_keyframe(atlas.keyframes[a]), view_of_keyframe(atlas.keyframes[b]), pose_options
        )
        if isinstance(measured, str):
            first, second = map_pair_of(atlas, a, b)
            failed[first, second, measured] += 1
        else:
            loop_closures.append(
                LoopClosure(
                    a=a,
                    b=b,
                    T_a_b=measured.T_a_b,
                    information=measured.information,
                    inliers=measured.inliers,
                    matches=measured.matches,
                )
            )
    return loop_closures, failed


def select_consistent(
    maps: tuple[int, int],
    loop_closures: Sequence[LoopClosure],
    T_world_camera: Array,
    options: MergeOptions,
) -> tuple[list[int], RejectionCounts]:
    """Return the indices of the loop closures that agree pairwise, and how many were rejected, by reason.

    The reasons are "against-odometry" (within one map), "inconsistent", and "too-few-agree" (between two
    maps; then all are rejected).

    Args:
        maps: The two maps that all loop closures connect, or one map twice.
        loop_closures: Their ends are rows of the two arrays.
        T_world_camera: ``(n, 4, 4)``, poses of the keyframes, each in the world frame of its own map.
        options: How many loop closures must agree to join two maps.
    """
    first, second = maps
    rejected: RejectionCounts = Counter()
    noise = OdometryNoise()
    candidates = list(range(len(loop_closures)))
    # 1. Within one map, reject the loop closures that contradict the odometry.
    if first == second:
        candidates = _find_fitting_odometry(T_world_camera, loop_closures, noise)
        rejected[first, second, "against-odometry"] += len(loop_closures) - len(candidates)
    # 2. Keep the largest set that agrees pairwise.
    consistent = find_consistent_set([loop_closures[index] for index in candidates], T_world_camera, noise)
    # 3. Between two maps, reject all loop closures if fewer than `min_links` agree.
    if first != second and len(consistent) < options.min_links:
        rejected[first, second, "too-few-agree"] += len(loop_closures)
        return [], rejected
    rejected[first, second, "inconsistent"] += len(candidates) - len(consistent)
    return [candidates[position] for position in consistent.tolist()], rejected


def map_pair_of(atlas: Atlas, a: int, b: int) -> tuple[int, int]:
    """Return the maps of the keyframes in rows *a* and *b*, the lower map first."""
    map_a, map_b = int(atlas.of_map[a]), int(atlas.of_map[b])
    return min(map_a, map_b), max(map_a, map_b)


def _find_fitting_odometry(
    T_world_camera: Array,
    loop_closures: Sequence[LoopClosure],
    noise: OdometryNoise,
) -> list[int]:
    """Return the indices of the loop closures that agree with odometry by `fits_prediction`.

    The poses *T_world_camera* ``(n, 4, 4)`` of the keyframes predict the relative poses.
    """
    if not loop_closures:
        return []
    edges = EdgeArrays.of(loop_closures)
    predicted = inverse(T_world_camera[edges.a]) @ T_world_camera[edges.b]
    steps = np.abs(edges.a - edges.b).astype(np.float64)
    lever_m = np.array([_lever_m(T_world_camera, closure) for closure in loop_closures])
    fits = fits_prediction(predicted, edges, steps, lever_m, noise)
    return [int(index) for index in np.flatnonzero(fits)]


def _lever_m(T_world_camera: Array, closure: LoopClosure) -> float:
    """Return the lever arm, in metres, with which a rotation error along a path displaces the end of the
    path.

    The path consists of the keyframes from the lower to the higher one of the two rows that *closure*
    connects.  The lever arm is the largest distance of its positions from that of the higher row.
    """
    first, last = sorted((closure.a, closure.b))
    path = T_world_camera[first : last + 1, :3, 3]
    return float(np.linalg.norm(path - path[-1], axis=1).max())
