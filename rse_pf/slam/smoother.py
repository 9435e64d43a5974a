"""Fit some dozens of poses to their edges by robust Gauss-Newton, the others held.

Pure numbers, by one thread and in a fixed order: the same numbers give the same bytes.
`rse_pf.slam.optimise` fits a whole graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, exp_se3, inverse, log_se3, skew

__all__ = ["SmoothedPoses", "smooth"]

Rows = npt.NDArray[np.int64]

_ITERATIONS = 6
_CONVERGED_M, _CONVERGED_RAD = 6e-3, 6e-3
_LITTLE = 1e-3
"""Share of the cost below which another step is not worth its time; after steps below 6 mm and 6 mrad the
next one is ten times shorter, and the next keyframe's smoothing makes it."""
_DAMPING = 1e-6
"""Of the diagonal; a free pose without an edge to a held one stays where it is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothedPoses:
    """The result of `smooth`.

    ``T`` ``(n, 4, 4)``; ``squares`` ``(m,)`` the squared Mahalanobis norm of each edge's residual;
    ``covariances`` ``(w, 6, 6)`` of the wanted poses, of twists on the right of a pose, given the held ones.
    """

    T: Array
    squares: Array
    covariances: Array


def smooth(
    T: Array, free: int, a: Rows, b: Rows, T_a_b: Array, information: Array, robust: npt.NDArray[np.bool_],
    *, cauchy: float, wanted: Rows | None = None,
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

    Source:
        Dellaert and Kaess, Factor Graphs for Robot Perception (2017), chapter 6.
    """
    T = T.copy()
    back = inverse(T_a_b)
    T_a_b_now, error, squares = _residuals(T, a, b, back, information)
    cost = _cost(squares, robust, cauchy)
    wanted = np.empty(0, dtype=np.int64) if wanted is None else wanted
    units = np.zeros((6 * free, 6 * len(wanted)))
    units[(6 * wanted[:, None] + np.arange(6)).ravel(), np.arange(6 * len(wanted))] = 1.0
    solved: Array = np.empty((6 * free, 1 + 6 * len(wanted)))
    for _ in range(_ITERATIONS):
        weights = _weights(squares, robust, cauchy)
        H, gradient = _normal_equations(T_a_b_now, free, a, b, error, information, weights)
        solved = np.linalg.solve(H, np.column_stack([-gradient, units])).astype(np.float64, copy=False)
        step = _bounded(solved[:, 0].reshape(free, 6))
        for _ in range(4):
            moved = T.copy()
            moved[:free] = _orthonormal(T[:free] @ exp_se3(step))
            T_moved, new_error, new_squares = _residuals(moved, a, b, back, information)
            new_cost = _cost(new_squares, robust, cauchy)
            if new_cost <= cost:
                break
            step = 0.25 * step
        else:
            break
        little = cost - new_cost <= _LITTLE * cost
        T, T_a_b_now, error, squares, cost = moved, T_moved, new_error, new_squares, new_cost
        moved_m, turned_rad = np.abs(step[:, :3]).max(), np.abs(step[:, 3:]).max()
        if little or (moved_m < _CONVERGED_M and turned_rad < _CONVERGED_RAD):
            break
    rows = 6 * wanted[:, None] + np.arange(6)
    columns = 1 + 6 * np.arange(len(wanted))[:, None] + np.arange(6)
    return SmoothedPoses(T=T, squares=squares, covariances=solved[rows[:, :, None], columns[:, None, :]])


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
