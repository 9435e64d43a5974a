"""Fit a window of some dozens of poses to their edges by robust Gauss-Newton, with all other poses fixed.

The computation is dense, in one thread and in a fixed order, so that equal inputs give equal bytes.
`rse_pf.slam.optimise` fits a whole pose graph with GTSAM instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, adjoint, exp_se3, inverse, log_se3, scaled, skew

__all__ = ["ScaleTerms", "SmoothedPoses", "smooth"]

Rows = npt.NDArray[np.int64]

_MAX_ITERATIONS = 6  # largest number of Gauss-Newton steps of one call of `smooth`
_MAX_STEP_TRIALS = 4
"""Largest number of trials of a Gauss-Newton step.  After each trial that increases the cost, the step is
shortened by the factor `_STEP_REDUCTION`; if all trials do, the step is not made, and the iterations end."""
_STEP_REDUCTION = 0.25  # factor by which a Gauss-Newton step that increases the cost is shortened
_CONVERGED_M = 6e-3
"""If a Gauss-Newton step moves no pose by this translation in metres along an axis, nor by `_CONVERGED_RAD`,
no further step is made.  It would be about ten times shorter, and the call of `smooth` for the next keyframe
makes up for it."""
_CONVERGED_RAD = 6e-3
"""If a Gauss-Newton step moves no pose by this rotation in radians about an axis, nor by `_CONVERGED_M`, no
further step is made."""
_MIN_RELATIVE_DECREASE = 1e-3
"""Relative decrease of the cost in a Gauss-Newton step up to which no further step is made."""
_MAX_ROTATION_STEP_RAD = 0.5
"""Largest rotation in radians of a pose about an axis in a Gauss-Newton step; beyond it the linearisation is
invalid, and the steps of all poses are shortened."""
_DAMPING = 1e-6
"""Levenberg damping: each diagonal element h of the normal equations becomes h + 1e-6 (h + 1), so that a free
pose without an edge stays where it is."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaleTerms:
    """Unknown scales, each multiplying the translations of some edges, that are fitted with the poses.

    Attributes:
        count: The number *k* of scales; the logarithm of each scale starts at 0.
        of_edge: ``(m,)``, index of the scale by which each edge's measured translation is multiplied, -1 for
            none.
        plus: ``(m,)``, index of the first of two scales whose ratio an edge measures, -1 for a scale fixed at
            1.
        minus: ``(m,)``, index of the second of these two scales, -1 for a scale fixed at 1.
        difference: ``(m,)``, the measured ``log(first scale) - log(second scale)``, natural logarithms.
        information: ``(m,)``, the inverse variance of this difference; 0 where an edge measures no ratio.
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

    Attributes:
        T: ``(n, 4, 4)``, all poses, metres.
        squares: ``(m,)``, the squared Mahalanobis norm of the residual of each edge at these poses, with that
            of the ratio of scales if the edge measures one.
        covariances: ``(w, 6, 6)``, for each of the *w* wanted poses the covariance of the twist (metres,
            radians) on its right.  It is conditional on the fixed poses, as if these had no errors, and is
            computed with the Cauchy weights and the Jacobians of the last iteration.
        log_scales: ``(k,)``, the natural logarithms of the fitted scales; empty without scales.
    """

    T: Array
    squares: Array
    covariances: Array
    log_scales: Array


def smooth(
    T: Array,
    free: int,
    a: Rows,
    b: Rows,
    T_a_b: Array,
    information: Array,
    robust: npt.NDArray[np.bool_],
    *,
    cauchy: float,
    wanted: Rows,
    scales: ScaleTerms | None = None,
) -> SmoothedPoses:
    """Fit the first *free* poses to the edges, and keep the other poses fixed; the arguments do not change.

    Minimises the sum of squared Mahalanobis norms r^2 of the residuals of odometry edges, and of
    ``cauchy^2 log(1 + r^2 / cauchy^2)`` of robust edges, by iteratively reweighted Gauss-Newton.  The
    residual of an edge is the twist ``log(inverse(T_a_b) @ inverse(T[a]) @ T[b])``.

    Args:
        T: ``(n, 4, 4)``, the poses, metres.
        free: The number of poses that may move; at least 1.
        a: ``(m,)``, the row in *T* of the first pose of each edge.
        b: ``(m,)``, the row in *T* of the second pose of each edge.
        T_a_b: ``(m, 4, 4)``, the measured relative poses.
        information: ``(m, 6, 6)``, the inverse covariances of the residuals (metres, radians).
        robust: ``(m,)``, whether an edge may be an outlier.
        cauchy: Width of the Cauchy kernel in standard deviations, above 0.
        wanted: Rows of free poses whose covariances are returned; may be empty.
        scales: Scales that are fitted together with the poses; None means none.

    Source:
        Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017, chapter 6.
    """
    # 1. Evaluate the residuals at the given poses.
    T = T.copy()
    T_b_a_measured = inverse(T_a_b)
    log_scales = np.zeros(0 if scales is None else scales.count)
    T_a_b_now, error, squares = _residuals(T, a, b, T_b_a_measured, information)
    if scales is not None:
        squares = squares + _scale_squares(scales, log_scales)
    cost = _cost(squares, robust, cauchy)
    # 2. Prepare unit vectors as further right sides of the normal equations: their solutions are the columns
    # of the inverse matrix that contain the covariances of the wanted poses.
    size = 6 * free + len(log_scales)
    unit_vectors = np.zeros((size, 6 * len(wanted)))
    unit_vectors[(6 * wanted[:, None] + np.arange(6)).ravel(), np.arange(6 * len(wanted))] = 1.0
    solved: Array = np.empty((size, 1 + 6 * len(wanted)))
    for _ in range(_MAX_ITERATIONS):
        # 3. Solve the reweighted normal equations.
        weights = _cauchy_weights(squares, robust, cauchy)
        H, gradient = _normal_equations(T_a_b_now, free, a, b, error, information, weights)
        if scales is not None:
            edges = _LinearisedEdges(a, b, T_a_b_now, T_b_a_measured, error, information, weights)
            H, gradient = _add_scales(H, gradient, scales, log_scales, edges)
        right = np.column_stack([-gradient, unit_vectors])
        solved = np.linalg.solve(H, right).astype(np.float64, copy=False)
        step = _limit_rotation(solved[: 6 * free, 0].reshape(free, 6))
        scale_step = solved[6 * free :, 0]
        # 4. Shorten the step until the cost does not increase; stop if no length helps.
        for _ in range(_MAX_STEP_TRIALS):
            new_T = T.copy()
            new_T[:free] = _orthonormalise(T[:free] @ exp_se3(step))
            new_measured = T_b_a_measured if scales is None else _rescale(T_b_a_measured, scales, scale_step)
            new_T_a_b, new_error, new_squares = _residuals(new_T, a, b, new_measured, information)
            if scales is not None:
                new_squares = new_squares + _scale_squares(scales, log_scales + scale_step)
            new_cost = _cost(new_squares, robust, cauchy)
            if new_cost <= cost:
                break
            step, scale_step = _STEP_REDUCTION * step, _STEP_REDUCTION * scale_step
        else:
            break
        # 5. Take the step, and end if it has lowered the cost, or moved the poses, by little.
        has_small_decrease = cost - new_cost <= _MIN_RELATIVE_DECREASE * cost
        T, T_a_b_now, error, squares, cost = new_T, new_T_a_b, new_error, new_squares, new_cost
        T_b_a_measured, log_scales = new_measured, log_scales + scale_step
        largest_m, largest_rad = np.abs(step[:, :3]).max(), np.abs(step[:, 3:]).max()
        if has_small_decrease or (largest_m < _CONVERGED_M and largest_rad < _CONVERGED_RAD):
            break
    # 6. Take the covariances of the wanted poses out of the last solution.
    rows = 6 * wanted[:, None] + np.arange(6)
    columns = 1 + 6 * np.arange(len(wanted))[:, None] + np.arange(6)
    return SmoothedPoses(
        T=T,
        squares=squares,
        covariances=solved[rows[:, :, None], columns[:, None, :]],
        log_scales=log_scales,
    )


def _residuals(
    T: Array, a: Rows, b: Rows, T_b_a_measured: Array, information: Array
) -> tuple[Array, Array, Array]:
    """Return for each edge the relative pose, the residual and its squared Mahalanobis norm at the poses *T*.

    The three arrays are ``inverse(T[a]) @ T[b]``, ``(m, 4, 4)``; its difference from the measured one as a
    twist on the right, ``(m, 6)``; and ``(m,)``.
    """
    T_a_b = inverse(T[a]) @ T[b]
    error = log_se3(T_b_a_measured @ T_a_b)
    weighted = (information @ error[:, :, None])[:, :, 0]
    return T_a_b, error, (error * weighted).sum(axis=1)


def _cauchy_weights(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> Array:
    return np.where(robust, 1.0 / (1.0 + squares / cauchy**2), 1.0)


def _cost(squares: Array, robust: npt.NDArray[np.bool_], cauchy: float) -> float:
    return float(np.where(robust, cauchy**2 * np.log1p(squares / cauchy**2), squares).sum())


def _normal_equations(
    T_a_b: Array, free: int, a: Rows, b: Rows, error: Array, information: Array, weights: Array
) -> tuple[Array, Array]:
    """Return the damped matrix ``(6 f, 6 f)`` and the gradient ``(6 f,)`` of the first *f* = *free* poses.

    The unknowns are twists on the right of the poses; their Jacobians are first-order approximations
    for small residuals.
    """
    # 1. Compute the Jacobians of the residuals and their products.
    J_b = np.eye(6) + 0.5 * _adjoint_twists(error)
    J_a = -J_b @ adjoint(inverse(T_a_b))
    J = np.concatenate([J_a, J_b], axis=2)
    WJ = (weights[:, None, None] * information) @ J
    blocks = np.swapaxes(J, 1, 2) @ WJ
    gradients = (np.swapaxes(WJ, 1, 2) @ error[:, :, None])[:, :, 0]
    # 2. Sum the diagonal blocks of each pose; products with 0 and 1 are faster than np.add.at.
    poses = np.arange(free)[:, None]
    is_a, is_b = (a == poses).astype(np.float64), (b == poses).astype(np.float64)
    diagonal_blocks = is_a @ blocks[:, :6, :6].reshape(-1, 36) + is_b @ blocks[:, 6:, 6:].reshape(-1, 36)
    # 3. Sum the blocks of edges between two free poses.
    both_free = np.flatnonzero((a < free) & (b < free))
    elements = 36 * (a[both_free] * free + b[both_free])[:, None] + np.arange(36)
    summed = np.bincount(
        elements.ravel(), weights=blocks[both_free, :6, 6:].ravel(), minlength=36 * free * free
    )
    # Without an edge np.bincount returns integers.
    half: Array = summed.astype(np.float64, copy=False).reshape(free, free, 6, 6)
    # 4. Assemble the symmetric matrix from the blocks of one half and half of the diagonal blocks.
    half[np.arange(free), np.arange(free)] = 0.5 * diagonal_blocks.reshape(free, 6, 6)
    flat = np.ascontiguousarray(half.transpose(0, 2, 1, 3)).reshape(6 * free, 6 * free)
    H = flat + flat.T
    diagonal = np.arange(6 * free)
    H[diagonal, diagonal] += _DAMPING * (H[diagonal, diagonal] + 1.0)
    return H, (is_a @ gradients[:, :6] + is_b @ gradients[:, 6:]).reshape(-1)


def _rescale(T_b_a_measured: Array, scales: ScaleTerms, scale_step: Array) -> Array:
    """Return the inverses ``(m, 4, 4)`` of the measured relative poses after the scales have changed.

    *scale_step* ``(k,)`` is what is added to the logarithms of the scales.
    """
    factors = np.where(scales.of_edge >= 0, np.exp(scale_step)[scales.of_edge], 1.0)
    return scaled(T_b_a_measured, factors)


def _scale_residuals(scales: ScaleTerms, log_scales: Array) -> Array:
    """Return ``(m,)``: the difference of two log scales less the difference that the edge measured."""
    plus = np.where(scales.plus >= 0, log_scales[scales.plus], 0.0)
    minus = np.where(scales.minus >= 0, log_scales[scales.minus], 0.0)
    return plus - minus - scales.difference


def _scale_squares(scales: ScaleTerms, log_scales: Array) -> Array:
    return scales.information * _scale_residuals(scales, log_scales) ** 2


@dataclass(frozen=True, slots=True)
class _LinearisedEdges:
    """The edges at the poses of one iteration, with the results of `_residuals` and `_cauchy_weights`."""

    a: Rows
    b: Rows
    T_a_b: Array
    T_b_a_measured: Array
    error: Array
    information: Array
    weights: Array


def _add_scales(
    H: Array, gradient: Array, scales: ScaleTerms, log_scales: Array, edges: _LinearisedEdges
) -> tuple[Array, Array]:
    """Return the normal equations of the poses, extended by the unknown log scales as last unknowns.

    If a log scale grows by a small d, the translation t of a measured pose ``T_a_b = (R, t)`` of its edges
    grows by ``d t``.  This is the motion ``d R^T t`` in the frame of the pose, which is ``-d`` times the
    translation of the inverse pose ``T_b_a``.  A residual e changes by ``-(I - ad(e) / 2)`` times the motion.
    """
    poses, k = len(gradient), scales.count
    error, weights = edges.error, edges.weights
    extended_H = np.zeros((poses + k, poses + k))
    extended_H[:poses, :poses] = H
    extended_gradient = np.concatenate([gradient, np.zeros(k)])
    # 1. Compute the Jacobians of the residuals of scaled edges by their scale.
    rows = np.flatnonzero(scales.of_edge >= 0)
    scale_columns = poses + scales.of_edge[rows]
    twists = _adjoint_twists(error[rows])
    J_b = np.eye(6) + 0.5 * twists
    motion = np.zeros((len(rows), 6))
    motion[:, :3] = -edges.T_b_a_measured[rows, :3, 3]
    J_s = -((np.eye(6) - 0.5 * twists) @ motion[:, :, None])[:, :, 0]
    # 2. Add the diagonal and the gradient of the scales.
    WJ = weights[rows, None] * (edges.information[rows] @ J_s[:, :, None])[:, :, 0]
    np.add.at(extended_H, (scale_columns, scale_columns), (J_s * WJ).sum(axis=1))
    np.add.at(extended_gradient, scale_columns, (WJ * error[rows]).sum(axis=1))
    # 3. Add the blocks between scales and free poses.
    J_a = -J_b @ adjoint(inverse(edges.T_a_b[rows]))
    for ends, J in ((edges.a[rows], J_a), (edges.b[rows], J_b)):
        is_free = np.flatnonzero(6 * ends < poses)
        block = (np.swapaxes(J[is_free], 1, 2) @ WJ[is_free, :, None])[:, :, 0]
        pose_columns = 6 * ends[is_free, None] + np.arange(6)
        np.add.at(extended_H, (pose_columns, scale_columns[is_free, None]), block)
        np.add.at(extended_H, (scale_columns[is_free, None], pose_columns), block)
    # 4. Add the measured ratios of scales.
    information = weights * scales.information
    weighted_residuals = information * _scale_residuals(scales, log_scales)
    for ends, sign in ((scales.plus, 1.0), (scales.minus, -1.0)):
        is_fitted = ends >= 0
        columns = poses + ends[is_fitted]
        np.add.at(extended_H, (columns, columns), information[is_fitted])
        np.add.at(extended_gradient, columns, sign * weighted_residuals[is_fitted])
    both = np.flatnonzero((scales.plus >= 0) & (scales.minus >= 0))
    for first, second in ((scales.plus, scales.minus), (scales.minus, scales.plus)):
        np.add.at(extended_H, (poses + first[both], poses + second[both]), -information[both])
    diagonal = poses + np.arange(k)
    extended_H[diagonal, diagonal] += _DAMPING * (extended_H[diagonal, diagonal] + 1.0)
    return extended_H, extended_gradient


def _limit_rotation(step: Array) -> Array:
    """Return the twists *step* ``(f, 6)``, all shortened alike if one is above 0.5 rad about an axis."""
    largest_rad = float(np.abs(step[:, 3:]).max())
    return step * (_MAX_ROTATION_STEP_RAD / largest_rad) if largest_rad > _MAX_ROTATION_STEP_RAD else step


def _orthonormalise(T: Array) -> Array:
    """Return poses whose rotations are orthonormal again, by one Newton step of the polar decomposition."""
    R = T[:, :3, :3]
    T = T.copy()
    T[:, :3, :3] = 1.5 * R - 0.5 * R @ np.swapaxes(R, 1, 2) @ R
    return T


def _adjoint_twists(xi: Array) -> Array:
    """Return ``(n, 6, 6)``: the adjoint representation ad(xi) of the twists *xi* ``(n, 6)``."""
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = skew(xi[:, 3:])
    ad[:, :3, 3:] = skew(xi[:, :3])
    return ad
