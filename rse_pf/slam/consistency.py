"""Test which loop closures agree with each other and with odometry: pairwise consistency maximisation.

A merge of stored maps and the live map share these tests.  They compare relative poses only, so the result
does not depend on the world frame in which a map is expressed.

Source:
    Mangelson et al., Pairwise consistent measurement set maximization for robust multi-robot map merging,
    ICRA 2018.  Kimera-RPGO has another implementation (``Pcm.h``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, log_se3, scaled

__all__ = [
    "CHI2_99_PERCENT_1",
    "EdgeArrays",
    "LoopClosure",
    "OdometryNoise",
    "are_pairwise_consistent",
    "evidence_weight",
    "find_consistent_set",
    "find_maximum_clique",
    "fits_prediction",
]

CHI2_99_PERCENT_3 = 11.345  # 99 % quantile of the chi-squared distribution with three degrees of freedom
CHI2_99_PERCENT_1 = 6.635  # 99 % quantile of the chi-squared distribution with one degree of freedom
FULL_WEIGHT_INLIERS = 30  # a loop closure with fewer inliers has a weight below 1, since they may be chance
FULL_WEIGHT_INLIER_RATIO = 0.5  # a loop closure with a smaller share of inliers has a weight below 1
MANY_VERTICES = 128  # number of vertices from which the clique search colours by bit sets, which is faster
MAX_CLIQUE_BRANCHES = 200_000
"""Branches that the clique search visits at most, so that hostile input cannot block a server; the largest
clique found until then is returned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise:
    """Drift of odometry as a random walk: the variance grows by the same amount in each step of odometry.

    What a step is depends on the caller that counts the steps: the motion between consecutive keyframes of a
    stored map (`rse_pf.slam.loop_closures`), or 0.25 m or 15 degrees of motion in a live map
    (`rse_pf.live_map.graph`).

    Attributes:
        step_m: Standard deviation of the translation along each axis in one step, metres.
        step_deg: Standard deviation of the rotation about each axis in one step, degrees.
        step_scale: Standard deviation, in one step, of the natural logarithm of the scale of a camera without
            depth.
    """

    step_m: float = 0.02
    step_deg: float = 0.7
    step_scale: float = 0.005


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopClosure:
    """A measured relative pose between the keyframes in rows ``a`` and ``b`` of one list.

    ``T_a_b`` ``(4, 4)`` maps points from the camera frame of *b* to that of *a*, metres.  ``information``
    ``(6, 6)`` is the inverse covariance of the twist (metres, radians) on its right.  ``inliers`` of the
    ``matches`` between both images fit the pose; both are 0 where they are not known.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    inliers: int = 0
    matches: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeArrays:
    """*m* measured relative poses as arrays: from the keyframes in rows ``a`` to those in rows ``b``.

    ``T_a_b`` is ``(m, 4, 4)``, and ``variances`` ``(m, 6)`` holds the variances of the twist on its right
    (square metres, square radians).  ``scales`` ``(m, 2)`` is given if the poses of *b* have another unit of
    length than those of *a*: the natural logarithm of the length of the unit of *b*, measured in the unit of
    *a*, and the variance of this logarithm.  ``T_a_b`` is then in the unit of *a*.
    """

    a: npt.NDArray[np.int64]
    b: npt.NDArray[np.int64]
    T_a_b: Array
    variances: Array
    scales: Array | None = None

    @classmethod
    def of(cls, loop_closures: Sequence[LoopClosure]) -> EdgeArrays:
        """Return *loop_closures*, at least one, as arrays without scales."""
        information = np.array([closure.information for closure in loop_closures])
        return cls(
            a=np.array([closure.a for closure in loop_closures], dtype=np.int64),
            b=np.array([closure.b for closure in loop_closures], dtype=np.int64),
            T_a_b=np.array([closure.T_a_b for closure in loop_closures]),
            variances=np.diagonal(np.linalg.inv(information), axis1=1, axis2=2),
        )

    def select(self, chosen: slice | npt.NDArray[np.int64]) -> EdgeArrays:
        """Return the relative poses at the positions *chosen*, a slice or an array of indices."""
        return replace(
            self,
            a=self.a[chosen],
            b=self.b[chosen],
            T_a_b=self.T_a_b[chosen],
            variances=self.variances[chosen],
            scales=None if self.scales is None else self.scales[chosen],
        )

    @property
    def mean_variances(self) -> tuple[Array, Array]:
        """For each relative pose the mean of the variances along or about the three axes, as two arrays.

        The first array is that of the translation, ``(m,)`` square metres, and the second that of the
        rotation, ``(m,)`` square radians.
        """
        return self.variances[:, :3].mean(axis=1), self.variances[:, 3:].mean(axis=1)


def evidence_weight(inliers: int, matches: int) -> float:
    """Return the weight of a loop closure within 0 to 1, by its inliers and by its inliers per match.

    The weight is the smallest of 1, ``inliers / 30`` and ``(inliers / matches) / 0.5``; the last one is left
    out if *matches* is 0.  Weights of several loop closures are added: two of weight 0.5 count as one of full
    weight.
    """
    ratio = inliers / matches if matches else 1.0
    return min(1.0, inliers / FULL_WEIGHT_INLIERS, ratio / FULL_WEIGHT_INLIER_RATIO)


def find_consistent_set(
    loop_closures: Sequence[LoopClosure],
    T_world_camera: Array,
    noise: OdometryNoise,
) -> npt.NDArray[np.int64]:
    """Return the sorted indices of the largest set of loop closures that agree pairwise; deterministic.

    Args:
        loop_closures: All between the same two trajectories, or all within one trajectory.
        T_world_camera: ``(n, 4, 4)``, poses of the keyframes by odometry, each trajectory in its own frame;
            the keyframes of a trajectory have consecutive rows.
        noise: Drift of the odometry from one keyframe to the next.

    Source:
        Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018.
    """
    if not loop_closures:
        return np.empty(0, dtype=np.int64)
    edges = EdgeArrays.of(loop_closures)
    # 1. Test all loop closures against each of them as the reference.
    agree = np.zeros((len(loop_closures), len(loop_closures)), dtype=np.bool_)
    for k in range(len(loop_closures)):
        steps = np.abs(edges.a - edges.a[k]) + np.abs(edges.b - edges.b[k])
        agree[k] = are_pairwise_consistent(T_world_camera, edges, edges.select(slice(k, k + 1)), steps, noise)
    # 2. Keep the pairs that agree in both directions: the test depends on which of both is the reference.
    agree &= agree.T
    np.fill_diagonal(agree, False)
    # 3. Find the largest set that agrees pairwise: a maximum clique of the graph of agreeing pairs.
    return find_maximum_clique(agree)


def are_pairwise_consistent(
    T: Array, edges: EdgeArrays, reference: EdgeArrays, steps: Array, noise: OdometryNoise
) -> npt.NDArray[np.bool_]:
    """Return ``(m,)``: whether each of *m* loop closures agrees with one reference loop closure.

    The round trip over both loop closures and the odometry between their ends must be the identity within
    its noise, which is that of both loop closures and of the odometry.  Translation and rotation are tested
    separately; each test accepts 99 % of the right loop closures.  A rotation error also displaces the end of
    the trip.  Therefore the sum of the variances of rotation, times the sum of the squared distances between
    both ends *a* and between both ends *b*, is added to the variance of the translation.

    If the two trajectories have different units of length, the two measured scales must agree as well, and
    the round trip uses the mean of their logarithms, weighted by their inverse variances.

    Args:
        T: ``(n, 4, 4)``, poses of keyframes by odometry.  The poses of all ends *a* are in one frame.  The
            poses of all ends *b* are in one frame, the same or another.
        edges: The *m* loop closures.
        reference: One loop closure between the same two trajectories.
        steps: ``(m,)``, steps of odometry between both ends *a* plus those between both ends *b*.
        noise: Drift of the odometry in one step.

    Source:
        Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018.
    """
    # 1. Compute the odometry between the ends of both loop closures.
    along_b = inverse(T[reference.b]) @ T[edges.b]
    along_a = inverse(T[edges.a]) @ T[reference.a]
    # 2. Where units of length differ, compute the mean of both measured scales and its variance; elsewhere
    #    the scales count as equal.
    scale_difference2, mean_scale_variance, scale_variance = np.zeros(1), np.zeros(1), np.ones(1)
    if edges.scales is not None and reference.scales is not None:
        difference = (edges.scales - reference.scales)[:, 0]
        scale_variance = edges.scales[:, 1] + reference.scales[:, 1]
        log_scale = reference.scales[:, 0] + difference * reference.scales[:, 1] / scale_variance
        along_b = scaled(along_b, np.exp(log_scale))
        scale_difference2 = difference**2
        mean_scale_variance = edges.scales[:, 1] * reference.scales[:, 1] / scale_variance
    # 3. Compute the round trip a_reference -> b_reference -> b -> a -> a_reference as a twist.
    trip = log_se3(reference.T_a_b @ along_b @ inverse(edges.T_a_b) @ along_a)
    # 4. Sum the variances of both loop closures and of the odometry between them.
    lever_m2 = (along_a[:, :3, 3] ** 2).sum(axis=1) + (along_b[:, :3, 3] ** 2).sum(axis=1)
    variance_m2, variance_rad2 = edges.mean_variances
    reference_m2, reference_rad2 = reference.mean_variances
    variance_rad2 = variance_rad2 + reference_rad2 + steps * math.radians(noise.step_deg) ** 2
    variance_m2 = variance_m2 + reference_m2 + steps * noise.step_m**2 + variance_rad2 * lever_m2
    # 5. Test translation and rotation against the chi-squared distribution; where units of length differ, add
    #    the variance of the scale, and test the scales, too.
    if edges.scales is None:
        return _are_twists_noise(trip, variance_m2, variance_rad2)
    variance_m2 = variance_m2 + mean_scale_variance * (along_b[:, :3, 3] ** 2).sum(axis=1)
    scale_variance = scale_variance + steps * noise.step_scale**2
    has_same_scale = scale_difference2 <= CHI2_99_PERCENT_1 * scale_variance
    return _are_twists_noise(trip, variance_m2, variance_rad2) & has_same_scale


def fits_prediction(
    T_a_b: Array, edges: EdgeArrays, steps: Array, lever_m: Array, noise: OdometryNoise
) -> npt.NDArray[np.bool_]:
    """Return ``(m,)``: whether each of *m* loop closures agrees with a predicted relative pose.

    Translation and rotation are tested separately, each by a chi-squared test that accepts 99 % of the right
    loop closures.

    Args:
        T_a_b: ``(m, 4, 4)``, the relative poses that odometry or a pose graph predicts.
        edges: The *m* measured loop closures.
        steps: ``(m,)``, steps of odometry from *a* to *b*; the variance of the prediction is proportional to
            their number.
        lever_m: ``(m,)``, lever arm in metres: a rotation error of the prediction, in radians, displaces *b*
            by this error times the lever arm.  An upper bound is the largest distance of *b* from the other
            positions of the path from *a* to *b*.
        noise: Drift of the odometry in one step.
    """
    error = log_se3(inverse(edges.T_a_b) @ T_a_b)
    variance_m2, variance_rad2 = edges.mean_variances
    drift_rad2 = steps * math.radians(noise.step_deg) ** 2
    return _are_twists_noise(
        error, variance_m2 + steps * noise.step_m**2 + drift_rad2 * lever_m**2, variance_rad2 + drift_rad2
    )


def _are_twists_noise(xi: Array, variance_m2: Array, variance_rad2: Array) -> npt.NDArray[np.bool_]:
    """Return ``(m,)``: whether translation and rotation of each twist ``(m, 6)`` are explained as noise.

    Each is tested by a chi-squared test that accepts 99 % of noise.  *variance_m2* and *variance_rad2*
    ``(m,)`` are the variances of translation and rotation along or about each axis.
    """
    fits: npt.NDArray[np.bool_] = ((xi[:, :3] ** 2).sum(axis=1) <= CHI2_99_PERCENT_3 * variance_m2) & (
        (xi[:, 3:] ** 2).sum(axis=1) <= CHI2_99_PERCENT_3 * variance_rad2
    )
    return fits


def find_maximum_clique(adjacency: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the sorted vertices of a maximum clique of a graph, by branch and bound.

    A greedy colouring bounds the size of a clique: each colour contributes one vertex at most.  Among cliques
    of equal size the first one found is returned.  The result is exact unless the search needs more than
    200,000 branches; then it is the largest clique found so far.

    Args:
        adjacency: ``(m, m)``, symmetric, with a diagonal of False.

    Source:
        Tomita and Kameda, An efficient branch-and-bound algorithm for finding a maximum clique, 2007.
    """
    neighbours = [frozenset(np.flatnonzero(row).tolist()) for row in adjacency]
    by_degree = sorted(range(len(neighbours)), key=lambda vertex: (-len(neighbours[vertex]), vertex))
    largest: list[int] = []
    branches_left = MAX_CLIQUE_BRANCHES
    # The stack of branches is explicit: a clique may be larger than the interpreter's recursion limit.
    stack: list[tuple[list[int], list[tuple[int, int]]]] = [
        ([], _colour_vertices(by_degree, neighbours, adjacency))
    ]
    while stack:
        clique, candidates = stack[-1]
        vertex, colours = candidates.pop() if candidates else (-1, 0)
        # 1. Leave this branch if no clique in it can be larger than the largest one found so far, or if the
        #    search has used all its branches.
        if len(clique) + colours <= len(largest) or branches_left <= 0:
            stack.pop()
            continue
        # 2. Add the vertex to the clique.
        branches_left -= 1
        grown = [*clique, vertex]
        largest = max(largest, grown, key=len)
        # 3. Go on with the clique that has this vertex; its candidates are the neighbours of the vertex.
        remaining = [candidate for candidate, _ in candidates if candidate in neighbours[vertex]]
        stack.append((grown, _colour_vertices(remaining, neighbours, adjacency)))
    return np.array(sorted(largest), dtype=np.int64)


def _colour_vertices(
    vertices: list[int], neighbours: list[frozenset[int]], adjacency: npt.NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Colour *vertices* greedily, so that neighbours have different colours.

    Returns:
        Pairs of a vertex and its colour, counted from 1, by ascending colour.  No clique of the vertices up
        to and including a pair is larger than the colour of this pair.
    """
    if len(vertices) >= MANY_VERTICES:
        return _colour_with_bit_sets(vertices, adjacency)
    classes: list[list[int]] = []
    for vertex in vertices:
        for colour_class in classes:
            if neighbours[vertex].isdisjoint(colour_class):
                colour_class.append(vertex)
                break
        else:
            classes.append([vertex])
    return [
        (vertex, colour) for colour, colour_class in enumerate(classes, start=1) for vertex in colour_class
    ]


def _colour_with_bit_sets(vertices: list[int], adjacency: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the same colouring as `_colour_vertices`; a set of vertices is the bits of one integer.

    Source:
        San Segundo et al., An exact bit-parallel algorithm for the maximum clique problem, 2011.
    """
    bits = np.packbits(adjacency[np.ix_(vertices, vertices)], axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in bits]
    coloured, uncoloured, colour = [], (1 << len(vertices)) - 1, 0
    while uncoloured:
        colour += 1
        allowed = uncoloured
        while allowed:
            lowest_bit = allowed & -allowed
            position = lowest_bit.bit_length() - 1
            coloured.append((vertices[position], colour))
            uncoloured ^= lowest_bit
            allowed = (allowed ^ lowest_bit) & ~neighbours[position]
    return coloured
