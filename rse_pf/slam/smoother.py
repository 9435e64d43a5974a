"""Fit some dozens of poses to their edges by robust Gauss-Newton, the others held.

Pure numbers, by one thread and in a fixed order: the same numbers give the same bytes.
`rse_pf.slam.optimise` fits a whole graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, exp_se3, inverse, log_se3, scaled, skew

__all__ = ["ScaleTerms", "SmoothedPoses", "smooth"]

Rows = npt.NDArray[np.int64]

_ITERATIONS = 6
_CONVERGED_M, _CONVERGED_RAD = 6e-3, 6e-3
_LITTLE = 1e-3
"""Share of the cost below which another step is not worth its time; after steps below 6 mm and 6 mrad the
next one is ten times shorter, and the next keyframe's smoothing makes it."""
_DAMPING = 1e-6
"""Of the diagonal; a free pose without an edge to a held one stays where it is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaleTerms:
    """Scales that are fitted with the poses: each multiplies the lengths of some edges.

    Attributes:
        count: The number *k* of scales; the logarithm of each begins at 0.
        of_edge: ``(m,)``, the scale of each edge's translation, -1 for none.
        plus, minus: ``(m,)``, the scales whose difference of logarithms an edge measures, -1 for none.
        difference: ``(m,)``, the measured one,
        information: and its inverse variance; 0 where an edge measures none.
    """

    count: int
    of_edge: Rows
    plus: Rows
    minus: Rows
    difference: Array
    information: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothedPoses:
    """The result of `smooth`.

    ``T`` ``(n, 4, 4)``; ``squares`` ``(m,)`` the squared Mahalanobis norm of each edge's residual;
    ``covariances`` ``(w, 6, 6)`` of the wanted poses, of twists on the right of a pose, given the held ones;
    ``log_scales`` ``(k,)``.
    """

    T: Array
    squares: Array
    covariances: Array
    log_scales: Array


def smooth(
    T: Array, free: int, a: Rows, b: Rows, T_a_b: Array, information: Array, robust: npt.NDArray[np.bool_],
    *, cauchy: float, wanted: Rows | None = None, scales: ScaleTerms | None = None,
) -> SmoothedPoses:  # fmt: skip
    """Fit the first *free* of the poses to the edges; the others are held.

    Minimises ``sum of squares`` of the edges that are not robust, and the sum of
    ``cauchy**2 log(1 + squares / cauchy**2)`` of the others.

    Args:
        T: ``(n, 4, 4)`` poses, metres.
        free: How many of them may move; at least 1.
        a, b: ``(m,)`` row numbers of the poses of each edge.
        T_a_b: ``(m, 4, 4)``, measured.
        information: ``(m, 6, 6)``, of the twist (metres, radians).
        robust: ``(m,)``, whether the edge may be wrong.
        cauchy: Width of the kernel, standard deviations.
        wanted: Rows of free poses whose covariance is asked for.
        scales: Fitted with the poses, if there are any.

    Source:
        Dellaert and Kaess, Factor Graphs for Robot Perception (2017), chapter 6.
    """
    T = T.copy()
    back = inverse(T_a_b)
    log_scales = np.zeros(0 if scales is None else scales.count)
    T_a_b_now, error, squares = _residuals(T, a, b, back, information)
    if scales is not None:
        squares = squares + _scale_squares(scales, log_scales)
    cost = _cost(squares, robust, cauchy)
    wanted = np.empty(0, dtype=np.int64) if wanted is None else wanted
    size = 6 * free + len(log_scales)
    units = np.zeros((size, 6 * len(wanted)))
    units[(6 * wanted[:, None] + np.arange(6)).ravel(), np.arange(6 * len(wanted))] = 1.0
    solved: Array = np.empty((size, 1 + 6 * len(wanted)))
    for _ in range(_ITERATIONS):
        weights = _weights(squares, robust, cauchy)
        H, gradient = _normal_equations(T_a_b_now, free, a, b, error, information, weights)
        if scales is not None:
            now = _Edges(a, b, T_a_b_now, back, error, information, weights)
            H, gradient = _with_scales(H, gradient, scales, log_scales, now)
        solved = np.linalg.solve(H, np.column_stack([-gradient, units])).astype(np.float64, copy=False)
        step, stretch = _bounded(solved[: 6 * free, 0].reshape(free, 6)), solved[6 * free :, 0]
        for _ in range(4):
            moved = T.copy()
            moved[:free] = _orthonormal(T[:free] @ exp_se3(step))
            new_back = back if scales is None else _stretched_back(back, scales, stretch)
            T_moved, new_error, new_squares = _residuals(moved, a, b, new_back, information)
            if scales is not None:
                new_squares = new_squares + _scale_squares(scales, log_scales + stretch)
            new_cost = _cost(new_squares, robust, cauchy)
            if new_cost <= cost:
                break
            step, stretch = 0.25 * step, 0.25 * stretch
        else:
            break
        little = cost - new_cost <= _LITTLE * cost
        T, T_a_b_now, error, squares, cost = moved, T_moved, new_error, new_squares, new_cost
        back, log_scales = new_back, log_scales + stretch
        moved_m, turned_rad = np.abs(step[:, :3]).max(), np.abs(step[:, 3:]).max()
        if little or (moved_m < _CONVERGED_M and turned_rad < _CONVERGED_RAD):
            break
    rows = 6 * wanted[:, None] + np.arange(6)
    columns = 1 + 6 * np.arange(len(wanted))[:, None] + np.arange(6)
    return SmoothedPoses(
        T=T, squares=squares, covariances=solved[rows[:, :, None], columns[:, None, :]],
        log_scales=log_scales,
    )  # fmt: skip


def _residuals(T: Array, a: Rows, b: Rows, back: Array, information: Array) -> tuple[Array, Array, Array]:
    """Return ``T_a_b`` by the poses, its twist from the measured one, and the squared norm of that."""
    T_a_b = inverse(T[a]) @ T[b]
    error = log_se3(back @ T_a_b)
    weighted = (information @ error[:, :, None])[:, :, 0]
    return T_a_b, error, (error * weighted).sum(axis=1)


def _weights(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> Array:
    return np.where(robust, 1.0 / (1.0 + squares / cauchy**2), 1.0)


def _cost(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> float:
    return float(np.where(robust, cauchy**2 * np.log1p(squares / cauchy**2), squares).sum())


def _normal_equations(
    T_a_b: Array, free: int, a: Rows, b: Rows, error: Array, information: Array, weights: Array
) -> tuple[Array, Array]:
    """Return the matrix ``(6 f, 6 f)`` and the gradient ``(6 f,)`` of the free poses."""
    J_b = np.eye(6) + 0.5 * _small_adjoints(error)
    J_a = -J_b @ adjoint(inverse(T_a_b))
    J = np.concatenate([J_a, J_b], axis=2)
    WJ = (weights[:, None, None] * information) @ J
    blocks = np.swapaxes(J, 1, 2) @ WJ
    slopes = (np.swapaxes(WJ, 1, 2) @ error[:, :, None])[:, :, 0]
    # Sums over the edges of a pose are products with ones and zeros, for the sake of time.
    poses = np.arange(free)[:, None]
    at_a, at_b = (a == poses).astype(np.float64), (b == poses).astype(np.float64)
    own = at_a @ blocks[:, :6, :6].reshape(-1, 36) + at_b @ blocks[:, 6:, 6:].reshape(-1, 36)
    both = np.flatnonzero((a < free) & (b < free))
    across = 36 * (a[both] * free + b[both])[:, None] + np.arange(36)
    summed = np.bincount(across.ravel(), weights=blocks[both, :6, 6:].ravel(), minlength=36 * free * free)
    # It counts in integers where there is nothing to add.
    half: Array = summed.astype(np.float64, copy=False).reshape(free, free, 6, 6)
    half[np.arange(free), np.arange(free)] = 0.5 * own.reshape(free, 6, 6)
    flat = np.ascontiguousarray(half.transpose(0, 2, 1, 3)).reshape(6 * free, 6 * free)
    H = flat + flat.T
    diagonal = np.arange(6 * free)
    H[diagonal, diagonal] += _DAMPING * (H[diagonal, diagonal] + 1.0)
    return H, (at_a @ slopes[:, :6] + at_b @ slopes[:, 6:]).reshape(-1)


def _stretched_back(back: Array, scales: ScaleTerms, stretch: Array) -> Array:
    """Return the inverse measured poses after the logarithms of the scales grew by *stretch*."""
    lengths = np.where(scales.of_edge >= 0, np.exp(stretch)[scales.of_edge], 1.0)
    return scaled(back, lengths)


def _scale_differences(scales: ScaleTerms, log_scales: Array) -> Array:
    """Return ``(m,)`` by how much the scales differ from what each edge measured."""
    here = np.where(scales.plus >= 0, log_scales[scales.plus], 0.0)
    there = np.where(scales.minus >= 0, log_scales[scales.minus], 0.0)
    return here - there - scales.difference


def _scale_squares(scales: ScaleTerms, log_scales: Array) -> Array:
    squares: Array = scales.information * _scale_differences(scales, log_scales) ** 2
    return squares


@dataclass(frozen=True, slots=True)
class _Edges:
    """The edges at the poses of one iteration, as `_residuals` and `_weights` return them."""

    a: Rows
    b: Rows
    T_a_b: Array
    back: Array
    error: Array
    information: Array
    weights: Array


def _with_scales(
    H: Array, gradient: Array, scales: ScaleTerms, log_scales: Array, edges: _Edges
) -> tuple[Array, Array]:
    """Return matrix and gradient of the poses with those of the scales behind.

    A scale that grows by d moves the measured pose by its own translation times d: in its own frame by
    ``-back`` of it, and the error the other way.
    """
    poses, k = len(gradient), scales.count
    error, weights = edges.error, edges.weights
    grown = np.zeros((poses + k, poses + k))
    grown[:poses, :poses] = H
    slopes = np.concatenate([gradient, np.zeros(k)])
    rows = np.flatnonzero(scales.of_edge >= 0)
    of_scale = poses + scales.of_edge[rows]
    small = _small_adjoints(error[rows])
    J_b = np.eye(6) + 0.5 * small
    along = np.zeros((len(rows), 6))
    along[:, :3] = -edges.back[rows, :3, 3]
    J_s = -((np.eye(6) - 0.5 * small) @ along[:, :, None])[:, :, 0]
    WJ = weights[rows, None] * (edges.information[rows] @ J_s[:, :, None])[:, :, 0]
    np.add.at(grown, (of_scale, of_scale), (J_s * WJ).sum(axis=1))
    np.add.at(slopes, of_scale, (WJ * error[rows]).sum(axis=1))
    J_a = -J_b @ adjoint(inverse(edges.T_a_b[rows]))
    for ends, J in ((edges.a[rows], J_a), (edges.b[rows], J_b)):
        inside = np.flatnonzero(6 * ends < poses)
        crossed = (np.swapaxes(J[inside], 1, 2) @ WJ[inside, :, None])[:, :, 0]
        columns = 6 * ends[inside, None] + np.arange(6)
        np.add.at(grown, (columns, of_scale[inside, None]), crossed)
        np.add.at(grown, (of_scale[inside, None], columns), crossed)
    weighted = weights * scales.information
    off = weighted * _scale_differences(scales, log_scales)
    for ends, sign in ((scales.plus, 1.0), (scales.minus, -1.0)):
        known = ends >= 0
        np.add.at(grown, (poses + ends[known], poses + ends[known]), weighted[known])
        np.add.at(slopes, poses + ends[known], sign * off[known])
    both = np.flatnonzero((scales.plus >= 0) & (scales.minus >= 0))
    for one, other in ((scales.plus, scales.minus), (scales.minus, scales.plus)):
        np.add.at(grown, (poses + one[both], poses + other[both]), -weighted[both])
    diagonal = poses + np.arange(k)
    grown[diagonal, diagonal] += _DAMPING * (grown[diagonal, diagonal] + 1.0)
    return grown, slopes


def _bounded(step: Array) -> Array:
    """Return the step, shortened where a rotation is beyond what a linear step means."""
    largest = float(np.abs(step[:, 3:]).max())
    return step * (0.5 / largest) if largest > 0.5 else step


def _orthonormal(T: Array) -> Array:
    """Return poses whose rotations are orthonormal again, by one Newton step of the polar form."""
    R = T[:, :3, :3]
    T = T.copy()
    T[:, :3, :3] = 1.5 * R - 0.5 * R @ np.swapaxes(R, 1, 2) @ R
    return T


def _small_adjoints(xi: Array) -> Array:
    """Return ``(n, 6, 6)``: the commutator with a twist, for the first order of a Jacobian."""
    small = np.zeros((len(xi), 6, 6))
    small[:, :3, :3] = small[:, 3:, 3:] = skew(xi[:, 3:])
    small[:, :3, 3:] = skew(xi[:, :3])
    return small
