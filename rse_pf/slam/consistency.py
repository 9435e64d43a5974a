"""Decide which measured relative poses (links) between keyframes agree: loops within and between maps.

Only links and odometry are compared, so the decision does not depend on the world frames of the maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, inverse, log_se3, scaled

__all__ = [
    "LinkEnds",
    "LoopClosure",
    "OdometryNoise",
    "StrongLink",
    "consistent",
    "fits_prediction",
    "largest_clique",
    "round_trips_close",
    "scale_fits",
]

_CHI2_3_99 = 11.345
"""99 % of the squared Mahalanobis norms of a 3-vector lie below."""
_CHI2_1_99 = 6.635
"""The same of one number."""
_MANY_ROWS = 128
_MAX_BRANCHES = 200_000
"""Limit of the clique search; beyond it the best clique so far is returned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryNoise:
    """Drift of odometry: standard deviations for each axis from one keyframe to the next (a random walk).

    ``step_scale`` is that of the logarithm of the scale of a camera without depth.
    """

    step_m: float = 0.02
    step_deg: float = 0.7
    step_scale: float = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class StrongLink:
    """The inliers, and their share of the matches, from which on a measured link counts whole."""

    inliers: int = 30
    ratio: float = 0.5

    def weight_of(self, inliers: int, matches: int) -> float:
        """Return how much a link counts beside others, within 0..1: its lesser share of both limits."""
        share = inliers / matches if matches else 1.0
        return min(1.0, inliers / self.inliers, share / self.ratio)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopClosure:
    """A measured relative pose of two keyframes (row numbers of one list)."""

    a: int
    b: int
    T_a_b: Array
    information: Array
    inliers: int = 0
    matches: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinkEnds:
    """*m* links as arrays: from rows *a* to rows *b*, ``T_a_b`` ``(m, 4, 4)``, variances ``(m, 6)``.

    The variances are of the twist (square metres, square radians).  Where the poses of all ends *b* have
    another unit than those of all ends *a*, in which ``T_a_b`` is, ``scales`` ``(m, 2)`` are the logarithm of
    how long it is in that, and its variance.
    """

    a: npt.NDArray[np.int64]
    b: npt.NDArray[np.int64]
    T_a_b: Array
    variances: Array
    scales: Array | None = None

    @classmethod
    def of(cls, links: Sequence[LoopClosure]) -> LinkEnds:
        """Return *links*, at least one, as arrays."""
        information = np.array([link.information for link in links])
        return cls(
            a=np.array([link.a for link in links], dtype=np.int64),
            b=np.array([link.b for link in links], dtype=np.int64),
            T_a_b=np.array([link.T_a_b for link in links]),
            variances=np.diagonal(np.linalg.inv(information), axis1=1, axis2=2),
        )

    def rows(self, which: slice | npt.NDArray[np.int64]) -> LinkEnds:
        """Return some of the links."""
        return replace(
            self, a=self.a[which], b=self.b[which], T_a_b=self.T_a_b[which], variances=self.variances[which],
            scales=None if self.scales is None else self.scales[which],
        )  # fmt: skip

    @property
    def mean_variances(self) -> tuple[Array, Array]:
        """The ``(m,)`` means of the variances of an axis: square metres, square radians."""
        return self.variances[:, :3].mean(axis=1), self.variances[:, 3:].mean(axis=1)


def consistent(
    links: Sequence[LoopClosure],
    T_world_camera: Array,
    order: npt.NDArray[np.int64],
    noise: OdometryNoise,
) -> npt.NDArray[np.int64]:
    """Return the rows of the largest set of *links* that agree pairwise; deterministic.

    Two links agree as `round_trips_close` says.

    Args:
        links: All between the same two trajectories (or within one).
        T_world_camera: ``(n, 4, 4)``, odometry of each trajectory in its own frame.
        order: ``(n,)``, index of each keyframe along its trajectory.
        noise: Of the odometry.
    """
    if not links:
        return np.empty(0, dtype=np.int64)
    ends = LinkEnds.of(links)
    agree = np.zeros((len(links), len(links)), dtype=np.bool_)
    for k in range(len(links)):
        walked = np.abs(order[ends.a] - order[ends.a[k]]) + np.abs(order[ends.b] - order[ends.b[k]])
        agree[k] = round_trips_close(T_world_camera, ends, ends.rows(slice(k, k + 1)), walked, noise)
    agree &= agree.T
    np.fill_diagonal(agree, False)
    return largest_clique(agree)


def round_trips_close(
    T: Array, links: LinkEnds, last: LinkEnds, walked: Array, noise: OdometryNoise
) -> npt.NDArray[np.bool_]:
    """Return for each of *m* links whether it agrees with one other link: the only test of a pair.

    The round trip a1 -> b1 -> b2 -> a2 -> a1 must be the identity; translation and rotation are tested
    separately, at 99 %, against the noise of both links and of the odometry between them; rotation noise acts
    on translation with the length of the path as its lever.

    Where their frames have different units, the scales of two links that agree do, too; the trip is judged by
    their mean.

    Args:
        T: ``(n, 4, 4)``, poses of keyframes; all ends *a* in one frame, and all ends *b* in one.
        links: The *m* links.
        last: The one link they are compared with.
        walked: ``(m,)``, steps of odometry between the ends *a* and between the ends *b* together.
        noise: Of one step of odometry.

    Source:
        Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018.
    """
    along_b = inverse(T[last.b]) @ T[links.b]
    along_a = inverse(T[links.a]) @ T[last.a]
    off2, scale2, apart2 = np.zeros(1), np.zeros(1), np.ones(1)
    if links.scales is not None and last.scales is not None:
        off, apart2 = (links.scales - last.scales)[:, 0], links.scales[:, 1] + last.scales[:, 1]
        # The mean by the information of both.
        log_scale = last.scales[:, 0] + off * last.scales[:, 1] / apart2
        along_b = scaled(along_b, np.exp(log_scale))
        off2, scale2 = off**2, links.scales[:, 1] * last.scales[:, 1] / apart2
    trip = log_se3(last.T_a_b @ along_b @ inverse(links.T_a_b) @ along_a)
    lever_m2 = (along_a[:, :3, 3] ** 2).sum(axis=1) + (along_b[:, :3, 3] ** 2).sum(axis=1)
    m2, rad2 = links.mean_variances
    last_m2, last_rad2 = last.mean_variances
    rad2 = rad2 + last_rad2 + walked * math.radians(noise.step_deg) ** 2
    m2 = m2 + last_m2 + walked * noise.step_m**2 + rad2 * lever_m2
    if links.scales is None:
        return within_noise(trip, m2, rad2)
    m2 = m2 + scale2 * (along_b[:, :3, 3] ** 2).sum(axis=1)
    return within_noise(trip, m2, rad2) & scale_fits(off2, apart2 + walked * noise.step_scale**2)


def fits_prediction(
    T_a_b: Array, links: LinkEnds, walked: Array, lever_m: Array, noise: OdometryNoise
) -> npt.NDArray[np.bool_]:
    """Return for each of *m* links whether it agrees with the pose that odometry or a graph predicts.

    Args:
        T_a_b: ``(m, 4, 4)``, predicted.
        links: The *m* measured links.
        walked: ``(m,)``, steps of odometry from *a* to *b*.
        lever_m: ``(m,)``, metres: how far a rotation along the way moves its end.
        noise: Of one step of odometry.
    """
    off = log_se3(inverse(links.T_a_b) @ T_a_b)
    m2, rad2 = links.mean_variances
    turned2 = walked * math.radians(noise.step_deg) ** 2
    return within_noise(off, m2 + walked * noise.step_m**2 + turned2 * lever_m**2, rad2 + turned2)


def scale_fits(off2: Array, variance: Array) -> npt.NDArray[np.bool_]:
    """Return whether squares ``(m,)`` of logarithms of scales are noise of these variances, at 99 %."""
    fits: npt.NDArray[np.bool_] = off2 <= _CHI2_1_99 * variance
    return fits


def within_noise(xi: Array, m2: Array, rad2: Array) -> npt.NDArray[np.bool_]:
    """Return whether ``(m, 6)`` twists are noise of these variances of each axis, at 99 % for each half."""
    close: npt.NDArray[np.bool_] = ((xi[:, :3] ** 2).sum(axis=1) <= _CHI2_3_99 * m2) & (
        (xi[:, 3:] ** 2).sum(axis=1) <= _CHI2_3_99 * rad2
    )
    return close


def largest_clique(agree: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Return the sorted rows of a largest set that agree pairwise; exact unless it is very large.

    *agree* is ``(m, m)``, symmetric, with a diagonal of False.

    Branch and bound with a greedy colouring as the bound; among equals the first found wins.

    Source:
        Tomita and Kameda, An efficient branch-and-bound algorithm for finding a maximum clique, 2007.
    """
    neighbours = [frozenset(np.flatnonzero(row).tolist()) for row in agree]
    by_degree = sorted(range(len(neighbours)), key=lambda row: (-len(neighbours[row]), row))
    best: list[int] = []
    left = _MAX_BRANCHES
    # A clique may be larger than the interpreter's recursion limit.
    branches: list[tuple[list[int], list[tuple[int, int]]]] = [([], _colour(by_degree, neighbours, agree))]
    while branches:
        clique, coloured = branches[-1]
        row, colours = coloured.pop() if coloured else (-1, 0)
        if len(clique) + colours <= len(best) or left <= 0:
            branches.pop()
            continue
        left -= 1
        grown = [*clique, row]
        best = max(best, grown, key=len)
        rest = [other for other, _ in coloured if other in neighbours[row]]
        branches.append((grown, _colour(rest, neighbours, agree)))
    return np.array(sorted(best), dtype=np.int64)


def _colour(
    rows: list[int], neighbours: list[frozenset[int]], agree: npt.NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Return rows with how many colours those up to each need: no clique in them is larger."""
    if len(rows) >= _MANY_ROWS:
        return _colour_many(rows, agree)
    classes: list[list[int]] = []
    for row in rows:
        for each in classes:
            if neighbours[row].isdisjoint(each):
                each.append(row)
                break
        else:
            classes.append([row])
    return [(row, colour) for colour, each in enumerate(classes, start=1) for row in each]


def _colour_many(rows: list[int], agree: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return what `_colour` does, class by class, by sets of rows that are bits of one integer each.

    Source:
        San Segundo et al., An exact bit-parallel algorithm for the maximum clique problem, 2011.
    """
    bits = np.packbits(agree[np.ix_(rows, rows)], axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in bits]
    coloured, left, colour = [], (1 << len(rows)) - 1, 0
    while left:
        colour += 1
        allowed = left
        while allowed:
            first = allowed & -allowed
            place = first.bit_length() - 1
            coloured.append((rows[place], colour))
            left ^= first
            allowed = (allowed ^ first) & ~neighbours[place]
    return coloured
