"""Estimate metric scale, gravity, velocities and biases from the poses of a camera and its IMU.

The camera's poses, which may be up to scale, are measurements with noise (a loosely coupled problem):

1. The bias of the gyroscope follows from the rotations of the poses (VINS-Mono, eq. 15).
2. A linear problem gives velocities, gravity and scale (VINS-Mono, Sect. V-B), and refuses a sensor with the
   wrong sign or scale.  Gravity is then set to 9.81 m/s^2.
3. A nonlinear least-squares problem refines these, and the rotations, positions and biases of all poses:
   residuals of preintegrated motions (Forster et al. 2017) and of poses, Huber loss, Levenberg-Marquardt.
   Each pose has biases of its own.

Source:
    Qin et al., "VINS-Mono", T-RO 2018, for steps 1 and 2; Campos et al., "Inertial-Only Optimization for
    Visual-Inertial Initialization", ICRA 2020, for estimating scale, gravity and biases with their noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from client_sdk.imu.checks import GRAVITY_M_S2, MAX_GRAVITY_ERROR_M_S2, describe_gravity_error
from client_sdk.imu.preintegration import Preintegration
from client_sdk.imu.samples import ImuModel
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_so3, left_jacobian_so3, log_so3, right_jacobian_so3, skew

__all__ = ["GRAVITY_M_S2", "ImuAlignment", "align_imu", "estimate_gyro_bias"]

# Parts of the state of one pose: rotation vector, position, velocity, gyroscope bias, accelerometer bias.
_STATE_SIZE = 15
_ROTATION = slice(0, 3)
_POSITION = slice(3, 6)
_VELOCITY = slice(6, 9)
_GYRO_BIAS = slice(9, 12)
_ACCEL_BIAS = slice(12, 15)
_BIASES = slice(9, 15)

_GYRO_BIAS_PRIOR_RAD_S = 0.1  # standard deviation of the gyroscope's bias before anything is measured
_ACCEL_BIAS_PRIOR_M_S2 = 0.2  # standard deviation of the accelerometer's bias before anything is measured
_HUBER_WIDTH = 3.0
"""Width of the Huber loss: the loss of a residual is linear where the root mean square of the residual's
three whitened components is above this."""
_CERTAIN_DEVIATIONS = 10.0
"""Standard deviations by which scale or gravity of the linear solution must be wrong to refuse the
accelerometer."""
_MAX_ITERATIONS = 12  # largest number of accepted Levenberg-Marquardt steps of one alignment
_CONVERGED_FRACTION = 1e-4
"""Levenberg-Marquardt ends with a step that lowers the cost by less than this fraction."""
_FIRST_DAMPING = 1e-5
"""Levenberg-Marquardt damping of the first step, as a share of the diagonal.  A step that does not lower the
cost multiplies the damping by 10; a step that does multiplies it by 0.1."""
_MIN_DAMPING = 1e-9  # smallest Levenberg-Marquardt damping of a step
_MAX_DAMPING = 1e8  # Levenberg-Marquardt damping above which the search for a better step is given up
_COVARIANCE_FLOOR = 1e-14  # added to variances of preintegrated motions, so that a Cholesky factor exists


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuAlignment:
    """Metric scale, gravity and biases that agree with the poses of a camera and the samples of its IMU.

    Attributes:
        scale: Metres per unit of the camera's poses.
        scale_deviation: Relative standard deviation of the scale; 0 for metric poses.
        gravity_m_s2: ``(3,)`` in the world of the poses; it points down, and its length is 9.81.
        gravity_deviation_rad: Standard deviation of the direction of gravity about its less certain axis.
        gyro_bias_rad_s: ``(3,)`` bias of the gyroscope at the last pose.
        accel_bias_m_s2: ``(3,)`` bias of the accelerometer at the last pose.
        misfit: Square root of the chi-square per degree of freedom: about 1 if the noise is as stated.  A
            misfit above 1 was multiplied into both deviations above.
    """

    scale: float
    scale_deviation: float
    gravity_m_s2: Array
    gravity_deviation_rad: float
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    misfit: float


def estimate_gyro_bias(R_world_imu: Array, motions: Sequence[Preintegration]) -> Array:
    """Return the ``(3,)`` gyroscope bias in rad/s with which motions fit the rotations ``(n, 3, 3)`` best.

    The n - 1 motions lie between neighbouring rotations.  One linear step is taken from the bias with which
    the first motion was preintegrated.  The step is exact only if all motions were preintegrated with nearly
    the same bias.

    Source:
        VINS-Mono, eq. 15.
    """
    measured = np.stack([motion.delta_rotation for motion in motions])
    J = np.stack([motion.bias_jacobian[:3, :3] for motion in motions])
    observed = np.swapaxes(R_world_imu[:-1], 1, 2) @ R_world_imu[1:]
    differences = log_so3(np.swapaxes(measured, 1, 2) @ observed)
    JT = np.swapaxes(J, 1, 2)
    change = np.linalg.solve((JT @ J).sum(axis=0), np.einsum("nij,nj->i", JT, differences))
    bias: Array = motions[0].gyro_bias_rad_s + change
    return bias


def align_imu(
    T_world_camera: Array,
    motions: Sequence[Preintegration],
    model: ImuModel,
    pose_noise: tuple[float, float],
    *,
    is_metric: bool = False,
) -> ImuAlignment | None:
    """Align an IMU with the poses of a camera.

    The result is None if the linear solution has a scale that is not above 0, or if the final equations have
    no valid covariance: then the poses do not determine scale and gravity.

    Args:
        T_world_camera: ``(n, 4, 4)`` poses, n >= 5, with translations in any one unit.
        motions: n - 1 preintegrated motions, each between two neighbouring poses.
        model: Model of the IMU.
        pose_noise: Standard deviations of a pose's rotation (rad) and position (unit of the poses).
        is_metric: Whether the unit of the poses is the metre, so that the scale is 1.

    Raises:
        UsageError: The scale is negative by more than ten standard deviations, or the magnitude of gravity is
            wrong by 0.6 m/s^2 and more than ten standard deviations: the accelerometer has the wrong sign,
            scale or bias.
    """
    problem = _AlignmentProblem(T_world_camera, motions, model, pose_noise, is_metric=is_metric)
    gyro_bias = estimate_gyro_bias(problem.observed_R, motions)
    linear_solution = problem.solve_linearly(gyro_bias)
    return None if linear_solution is None else problem.refine(*linear_solution, gyro_bias)


def _deviations_of_last(matrix: Array, residuals: Array, count: int) -> Array:
    """Return the ``(count,)`` standard deviations of the last unknowns of a linear least-squares problem.

    The noise is estimated from the residuals.  All are infinite if the problem does not determine them.
    """
    variance = np.square(residuals).sum() / max(1, len(residuals) - matrix.shape[1])
    # In the QR decomposition the last rows of R contain the last unknowns alone.
    R = np.asarray(np.linalg.qr(matrix, mode="r"))[-count:, -count:]
    if not np.abs(np.diag(R)).min() > 0.0:
        return np.full(count, np.inf)
    deviations: Array = np.sqrt(variance * np.square(np.linalg.inv(R)).sum(axis=1))
    return deviations


class _AlignmentProblem:
    """Nonlinear least squares over the states of all poses, the scale, and the direction of gravity.

    Only the states of neighbours are coupled, and all states with scale and gravity.  The normal equations
    are therefore block tridiagonal with a border, and are solved in time proportional to the number of poses.
    """

    def __init__(
        self,
        T_world_camera: Array,
        motions: Sequence[Preintegration],
        model: ImuModel,
        pose_noise: tuple[float, float],
        *,
        is_metric: bool,
    ) -> None:
        self.observed_R: Array = T_world_camera[:, :3, :3] @ model.T_imu_camera[:3, :3].T
        """Rotations ``R_world_imu`` ``(n, 3, 3)`` of the poses."""
        self._camera_in_imu = model.T_imu_camera[:3, 3]
        self._observed_p = T_world_camera[:, :3, 3]
        self._rotation_noise, self._position_noise = pose_noise
        self._is_metric = is_metric
        self._dt = np.array([motion.duration_s for motion in motions])
        self._delta_rotations = np.stack([motion.delta_rotation for motion in motions])
        self._deltas = np.stack(
            [np.concatenate([motion.delta_velocity_m_s, motion.delta_position_m]) for motion in motions]
        )
        self._J = np.stack([motion.bias_jacobian for motion in motions])
        self._motion_biases = np.stack(
            [np.concatenate([motion.gyro_bias_rad_s, motion.accel_bias_m_s2]) for motion in motions]
        )
        # Square roots of the information matrices of motions and of the biases' random walk.
        walk = np.repeat([model.gyro_walk, model.accel_walk], 3) ** 2
        self._sqrt_information = np.zeros((len(motions), 15, 15))
        for row, motion in enumerate(motions):
            covariance = motion.covariance + _COVARIANCE_FLOOR * np.eye(9)
            self._sqrt_information[row, :9, :9] = np.linalg.inv(np.linalg.cholesky(covariance))
            self._sqrt_information[row, 9:, 9:] = np.diag(1.0 / np.sqrt(walk * motion.duration_s))

    def solve_linearly(self, gyro_bias: Array) -> tuple[float, Array, Array] | None:
        """Return scale, gravity ``(3,)`` and velocities ``(n, 3)`` of the IMU by linear least squares.

        Gravity (m/s^2) and velocities (m/s) are in the world of the poses.  The accelerometer's bias is taken
        as 0.  All three components of gravity are estimated; then gravity is scaled to 9.81 m/s^2.  The
        result is None if the scale is not above 0.

        Raises:
            UsageError: See `align_imu`.
        """
        # 1. Correct the motions for the change of the gyroscope bias.
        R, p, dt = self.observed_R, self._observed_p, self._dt
        n = len(R)
        bias_change = gyro_bias - self._motion_biases[:, :3]
        deltas = self._deltas + np.einsum("nij,nj->ni", self._J[:, 3:, :3], bias_change)
        # 2. Set up 6 equations for each motion; the unknowns are n velocities, gravity and scale.
        A, b = np.zeros((n - 1, 6, 3 * n + 4)), np.zeros((n - 1, 6))
        for row in range(n - 1):
            velocity, next_velocity = slice(3 * row, 3 * row + 3), slice(3 * row + 3, 3 * row + 6)
            A[row, :3, velocity], A[row, :3, next_velocity] = -np.eye(3), np.eye(3)
            A[row, :3, 3 * n : 3 * n + 3] = -dt[row] * np.eye(3)
            A[row, 3:, velocity] = -dt[row] * np.eye(3)
            A[row, 3:, 3 * n : 3 * n + 3] = -0.5 * dt[row] ** 2 * np.eye(3)
            A[row, 3:, -1] = p[row + 1] - p[row]
            b[row, :3] = R[row] @ deltas[row, :3]
            b[row, 3:] = R[row] @ deltas[row, 3:] + (R[row + 1] - R[row]) @ self._camera_in_imu
        matrix, right = A.reshape(-1, 3 * n + 4), b.ravel()
        if self._is_metric:
            right, matrix = right - matrix[:, -1], matrix[:, :-1]
        # 3. Solve the equations by least squares.
        solution = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
        scale = 1.0 if self._is_metric else float(solution[-1])
        gravity: Array = solution[3 * n : 3 * n + 3]
        magnitude = float(np.linalg.norm(gravity))
        # 4. Refuse an accelerometer whose sign or scale is certainly wrong.
        if not self._is_metric and scale < 0.0:
            deviations = _deviations_of_last(matrix, right - matrix @ solution, 1)
            if -scale > _CERTAIN_DEVIATIONS * deviations[0]:
                raise UsageError(
                    "the accelerometer measures the opposite of how the camera moves: an axis has the wrong "
                    "sign",
                    hint="a stationary accelerometer reads 9.81 upwards; correct its axes, or T_imu_camera",
                )
        if not scale > 0.0 or not magnitude > 0.0:
            return None
        if abs(magnitude - GRAVITY_M_S2) > MAX_GRAVITY_ERROR_M_S2:
            deviations = _deviations_of_last(matrix, right - matrix @ solution, 3 if self._is_metric else 4)
            excess = abs(magnitude - GRAVITY_M_S2) - MAX_GRAVITY_ERROR_M_S2
            if excess > _CERTAIN_DEVIATIONS * deviations[:3].max():
                raise UsageError(
                    describe_gravity_error(magnitude, "for gravity, compared with the motion of the camera"),
                    hint="calibrate the accelerometer: it must read 9.81 m/s^2 while it is stationary",
                )
        # 5. Set the magnitude of gravity to 9.81 m/s^2; its direction stays.
        gravity = gravity * (GRAVITY_M_S2 / magnitude)
        velocities: Array = solution[: 3 * n].reshape(n, 3)
        return scale, gravity, velocities

    def refine(
        self, scale: float, gravity: Array, velocities: Array, gyro_bias: Array
    ) -> ImuAlignment | None:
        """Refine a first solution by Levenberg-Marquardt.

        The arguments are those that `solve_linearly` returns, and the ``(3,)`` gyroscope bias.  The result
        is None if it has no covariance with positive variances.
        """
        n = len(self._observed_p)
        state = _State(
            R=self.observed_R.copy(),
            p=scale * self._observed_p - self.observed_R @ self._camera_in_imu,
            v=velocities.copy(),
            biases=np.tile(np.concatenate([gyro_bias, np.zeros(3)]), (n, 1)),
            scale=scale,
            gravity=gravity,
        )
        cost, damping = self._cost(state), _FIRST_DAMPING
        equations = self._linearise(state)
        accepted_steps, is_converged = 0, False
        while accepted_steps < _MAX_ITERATIONS and damping < _MAX_DAMPING and not is_converged:
            candidate = state.moved_by(*equations.solve(damping))
            candidate_cost = self._cost(candidate)
            if candidate_cost < cost:
                is_converged = cost - candidate_cost < _CONVERGED_FRACTION * cost
                state, cost, damping = candidate, candidate_cost, max(0.1 * damping, _MIN_DAMPING)
                equations = self._linearise(state)
                accepted_steps += 1
            else:
                damping *= 10.0
        return self._make_alignment(state, equations)

    def _make_alignment(self, state: _State, equations: _NormalEquations) -> ImuAlignment | None:
        """Return the alignment with its deviations, which come from the inverse of the normal equations.

        None if these are singular, or have a variance that is not positive.
        """
        covariance = equations.last_covariance()
        if covariance is None or not np.isfinite(covariance).all():
            return None
        motion_residuals, pose_residuals = self._residuals(state)
        unknowns = _STATE_SIZE * len(pose_residuals) + len(equations.border_gradient)
        freedom = motion_residuals.size + pose_residuals.size + 6 - unknowns  # 6: priors of the first biases
        chi_square = np.square(motion_residuals).sum() + np.square(pose_residuals).sum()
        misfit = float(np.sqrt(chi_square / freedom))
        covariance *= max(1.0, misfit) ** 2
        tilt_begin = _STATE_SIZE if self._is_metric else _STATE_SIZE + 1
        tilt_covariance = covariance[tilt_begin:, tilt_begin:]
        return ImuAlignment(
            scale=state.scale,
            scale_deviation=0.0 if self._is_metric else float(np.sqrt(covariance[_STATE_SIZE, _STATE_SIZE])),
            gravity_m_s2=state.gravity,
            gravity_deviation_rad=float(np.sqrt(np.linalg.eigvalsh(tilt_covariance)[-1])),
            gyro_bias_rad_s=state.biases[-1, :3],
            accel_bias_m_s2=state.biases[-1, 3:],
            misfit=misfit,
        )

    def _cost(self, state: _State) -> float:
        motion_residuals, pose_residuals = self._residuals(state)
        prior = (state.biases[0] / _bias_prior()) ** 2
        return float(_huber_cost(motion_residuals).sum() + _huber_cost(pose_residuals).sum() + prior.sum())

    def _residuals(self, state: _State) -> tuple[Array, Array]:
        """Return the whitened residuals of motions ``(n - 1, 15)`` and of poses ``(n, 6)``.

        Those of a pose are three of its rotation, then three of the camera's position.
        """
        raw, _ = self._motion_residuals(state)
        motion_residuals = np.einsum("nij,nj->ni", self._sqrt_information, raw)
        rotations = log_so3(np.swapaxes(self.observed_R, 1, 2) @ state.R) / self._rotation_noise
        camera_positions = state.p + state.R @ self._camera_in_imu
        positions = (camera_positions - state.scale * self._observed_p) / (self._position_noise * state.scale)
        return motion_residuals, np.concatenate([rotations, positions], axis=1)

    def _motion_residuals(self, state: _State) -> tuple[Array, Array]:
        """Return the residuals of motions ``(n - 1, 15)`` in their own units, and rotation corrections.

        The residuals are those of rotation (rad), velocity (m/s), position (m) and the change of both biases.
        A motion was preintegrated with another gyroscope bias than that of *state*; its correction, a row of
        ``(n - 1, 3)``, is the rotation vector (rad) of the rotation that is multiplied on the right of the
        preintegrated rotation for this difference.
        """
        RT = np.swapaxes(state.R[:-1], 1, 2)
        bias_changes = state.biases[:-1] - self._motion_biases
        corrections = np.einsum("nij,nj->ni", self._J, bias_changes)
        raw = np.empty((len(self._dt), 15))
        rotations = self._delta_rotations @ exp_so3(corrections[:, :3])
        raw[:, :3] = log_so3(np.swapaxes(rotations, 1, 2) @ RT @ state.R[1:])
        deltas = self._deltas + corrections[:, 3:]
        raw[:, 3:6] = np.einsum("nij,nj->ni", RT, self._velocity_changes(state)) - deltas[:, :3]
        raw[:, 6:9] = np.einsum("nij,nj->ni", RT, self._position_changes(state)) - deltas[:, 3:]
        raw[:, 9:] = state.biases[1:] - state.biases[:-1]
        return raw, corrections[:, :3]

    def _velocity_changes(self, state: _State) -> Array:
        """Return the changes of velocity ``(n - 1, 3)`` in the world minus gravity times duration, m/s."""
        changes: Array = state.v[1:] - state.v[:-1] - self._dt[:, None] * state.gravity
        return changes

    def _position_changes(self, state: _State) -> Array:
        """Return ``p_j - p_i - v_i dt - g dt^2 / 2`` of each motion ``(n - 1, 3)`` in the world, m."""
        dt = self._dt[:, None]
        changes: Array = state.p[1:] - state.p[:-1] - dt * state.v[:-1] - 0.5 * dt**2 * state.gravity
        return changes

    def _linearise(self, state: _State) -> _NormalEquations:
        """Return the normal equations at a state, with the weights of the Huber loss.

        The border holds the logarithm of the scale (unless the poses are metric) and two angles of gravity.

        Source:
            Jacobians of preintegrated motions: Forster et al. 2017, appendix C.
        """
        n, border_size = len(self._observed_p), 2 if self._is_metric else 3
        # 1. Differentiate the residuals of motions by the states at their begin (before) and at their end
        # (after), and by the border.
        raw, rotation_corrections = self._motion_residuals(state)
        RT = np.swapaxes(state.R[:-1], 1, 2)
        dt = self._dt[:, None, None]
        inverse_right_jacobian = np.asarray(np.linalg.inv(right_jacobian_so3(raw[:, :3])), dtype=np.float64)
        before, after = np.zeros((n - 1, 15, 15)), np.zeros((n - 1, 15, 15))
        border = np.zeros((n - 1, 15, border_size))
        before[:, _ROTATION, _ROTATION] = (
            -inverse_right_jacobian @ np.swapaxes(state.R[1:], 1, 2) @ state.R[:-1]
        )
        after[:, _ROTATION, _ROTATION] = inverse_right_jacobian
        # A change d of the bias turns a rotation residual r into Log(Exp(-J d) Exp(r)): it acts on the left,
        # so that the inverse left Jacobian is needed.
        before[:, _ROTATION, _GYRO_BIAS] = (
            -np.linalg.inv(left_jacobian_so3(raw[:, :3]))
            @ right_jacobian_so3(rotation_corrections)
            @ self._J[:, :3, :3]
        )
        before[:, 3:6, _ROTATION] = skew(np.einsum("nij,nj->ni", RT, self._velocity_changes(state)))
        before[:, 6:9, _ROTATION] = skew(np.einsum("nij,nj->ni", RT, self._position_changes(state)))
        before[:, 3:6, _VELOCITY] = -RT
        after[:, 3:6, _VELOCITY] = RT
        before[:, 6:9, _POSITION] = -RT
        after[:, 6:9, _POSITION] = RT
        before[:, 6:9, _VELOCITY] = -dt * RT
        before[:, 3:9, _BIASES] = -self._J[:, 3:]
        before[:, 9:, _BIASES] = -np.eye(6)
        after[:, 9:, _BIASES] = np.eye(6)
        gravity_by_angles = -skew(state.gravity) @ _tangents(state.gravity)
        border[:, 3:6, border_size - 2 :] = -dt * RT @ gravity_by_angles
        border[:, 6:9, border_size - 2 :] = -0.5 * dt**2 * RT @ gravity_by_angles
        # 2. Whiten these derivatives and the residuals of motions, and weight them.
        motion_residuals, pose_residuals = self._residuals(state)
        weights = np.sqrt(_huber_weights(motion_residuals))[:, :, None]
        before, after, border = (
            weights * (self._sqrt_information @ jacobian) for jacobian in (before, after, border)
        )
        motion_residuals = weights[:, :, 0] * motion_residuals
        # 3. Differentiate the residuals of poses, and weight them.
        own, own_border = np.zeros((n, 6, 15)), np.zeros((n, 6, border_size))
        rotation_residuals = pose_residuals[:, :3] * self._rotation_noise
        own[:, :3, _ROTATION] = np.linalg.inv(right_jacobian_so3(rotation_residuals)) / self._rotation_noise
        noise_m = self._position_noise * state.scale
        own[:, 3:, _ROTATION] = -state.R @ skew(self._camera_in_imu) / noise_m
        own[:, 3:, _POSITION] = np.eye(3) / noise_m
        if not self._is_metric:
            own_border[:, 3:, 0] = -state.scale * self._observed_p / noise_m
        weights = np.sqrt(_huber_weights(pose_residuals))[:, :, None]
        own, own_border = weights * own, weights * own_border
        pose_residuals = weights[:, :, 0] * pose_residuals
        # 4. Add poses and motions to the normal equations, and the prior of the first biases.
        equations = _NormalEquations(n, border_size)
        equations.add(slice(None), own, own_border, pose_residuals)
        equations.add_border(own_border, pose_residuals)
        equations.add(slice(None, -1), before, border, motion_residuals)
        equations.add(slice(1, None), after, border, motion_residuals)
        equations.add_border(border, motion_residuals)
        equations.coupling += np.swapaxes(before, 1, 2) @ after
        information = 1.0 / _bias_prior() ** 2
        equations.diagonal[0, 9:, 9:] += np.diag(information)
        equations.gradient[0, 9:] += information * state.biases[0]
        return equations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    """The unknowns: the states of n poses of the IMU, the scale, and gravity.

    Attributes:
        R: ``(n, 3, 3)``, rotations ``R_world_imu``.
        p: ``(n, 3)``, positions in the world, m.
        v: ``(n, 3)``, velocities in the world, m/s.
        biases: ``(n, 6)`` of the gyroscope (rad/s), then of the accelerometer (m/s^2).
        scale: Metres per unit of the camera's poses.
        gravity: ``(3,)`` in the world, m/s^2.
    """

    R: Array
    p: Array
    v: Array
    biases: Array
    scale: float
    gravity: Array

    def moved_by(self, steps: Array, border_step: Array) -> _State:
        """Return the state after steps ``(n, 15)`` of the poses and ``(2,)`` or ``(3,)`` of the border.

        Rotations are multiplied on the right.  The border has the change of the scale's logarithm, if it has
        three numbers, and the angles, rad, by which gravity rotates about its two `_tangents`.
        """
        scale = self.scale * float(np.exp(border_step[0])) if len(border_step) == 3 else self.scale
        turn = exp_so3(_tangents(self.gravity) @ border_step[-2:])
        return _State(
            R=self.R @ exp_so3(steps[:, _ROTATION]),
            p=self.p + steps[:, _POSITION],
            v=self.v + steps[:, _VELOCITY],
            biases=self.biases + steps[:, _BIASES],
            scale=scale,
            gravity=turn @ self.gravity,
        )


class _NormalEquations:
    """Block tridiagonal normal equations with a border, solved by block elimination.

    For n states of 15 unknowns and a border of m unknowns: ``diagonal`` ``(n, 15, 15)``, ``coupling``
    ``(n - 1, 15, 15)`` of each state with the next, ``border`` ``(n, 15, m)`` of each state with the border,
    ``corner`` ``(m, m)`` of the border with itself, and the gradients (Jacobian transposed times residuals)
    ``(n, 15)`` and ``(m,)``.
    """

    def __init__(self, n: int, m: int) -> None:
        self.diagonal = np.zeros((n, _STATE_SIZE, _STATE_SIZE))
        self.coupling = np.zeros((n - 1, _STATE_SIZE, _STATE_SIZE))
        self.border, self.corner = np.zeros((n, _STATE_SIZE, m)), np.zeros((m, m))
        self.gradient, self.border_gradient = np.zeros((n, _STATE_SIZE)), np.zeros(m)

    def add(self, rows: slice, J: Array, border: Array, residuals: Array) -> None:
        """Add what ``(m, k)`` residuals say of the states *rows* alone, and of these and the border.

        *J* ``(m, k, 15)`` and *border* are the Jacobians of the residuals by these states and by the border.
        """
        JT = np.swapaxes(J, 1, 2)
        self.diagonal[rows] += JT @ J
        self.border[rows] += JT @ border
        self.gradient[rows] += np.einsum("nij,nj->ni", JT, residuals)

    def add_border(self, border: Array, residuals: Array) -> None:
        """Add what ``(m, k)`` residuals say of the border alone; *border* is their Jacobian by the border."""
        borderT = np.swapaxes(border, 1, 2)
        self.corner += (borderT @ border).sum(axis=0)
        self.border_gradient += np.einsum("nij,nj->i", borderT, residuals)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of the states ``(n, 15)`` and of the border ``(m,)`` against the gradient.

        *damping* is the share of each diagonal element that is added to it; the equations stay as they are.
        """
        # 1. Eliminate all states, so that equations of the border alone remain.
        eliminated: list[Array] = []
        D, C, G, b, c = self._eliminate_all_but_last(damping, eliminated)
        solved = np.asarray(np.linalg.solve(D, np.column_stack([b, C])), dtype=np.float64)
        eliminated.append(solved)
        G, c = G - C.T @ solved[:, 1:], c - C.T @ solved[:, 0]
        # 2. Solve for the border, then substitute back from the last state to the first.
        n, m = len(self.diagonal), len(c)
        border_step = np.asarray(np.linalg.solve(G, -c), dtype=np.float64)
        steps = np.empty((n, _STATE_SIZE))
        next_step = np.zeros(_STATE_SIZE)
        for row in range(n - 1, -1, -1):
            solved = eliminated[row]
            steps[row] = -solved[:, 0] - solved[:, 1 : 1 + m] @ border_step
            if row < n - 1:
                steps[row] -= solved[:, 1 + m :] @ next_step
            next_step = steps[row]
        return steps, border_step

    def last_covariance(self) -> Array | None:
        """Return the covariance ``(15 + m, 15 + m)`` of the last state and the border.

        None if the equations are singular, or a variance is not positive.
        """
        D, C, G, _, _ = self._eliminate_all_but_last(0.0)
        try:
            covariance: Array = np.linalg.inv(np.block([[D, C], [C.T, G]]))
        except np.linalg.LinAlgError:
            return None
        return covariance if (np.diag(covariance) > 0.0).all() else None

    def _eliminate_all_but_last(
        self, damping: float, eliminated: list[Array] | None = None
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Eliminate the states from the first to the last but one.

        Return diagonal and border of the last state, the corner, and the gradients of the last state and of
        the border.  For each eliminated state, the matrix ``inverse(D) [b, C, E]`` is appended to
        *eliminated*: D, b, C and E are the state's diagonal, gradient, border and coupling after the states
        before were eliminated.
        """
        n, m = len(self.diagonal), len(self.border_gradient)
        G, c = self.corner + damping * np.diag(np.diag(self.corner)), self.border_gradient.copy()
        D, C, b = self._damped_diagonal(0, damping), self.border[0], self.gradient[0]
        for row in range(n - 1):
            E = self.coupling[row]
            solved = np.asarray(np.linalg.solve(D, np.column_stack([b, C, E])), dtype=np.float64)
            if eliminated is not None:
                eliminated.append(solved)
            ET, CT = E.T, C.T
            G, c = G - CT @ solved[:, 1 : 1 + m], c - CT @ solved[:, 0]
            D = self._damped_diagonal(row + 1, damping) - ET @ solved[:, 1 + m :]
            C = self.border[row + 1] - ET @ solved[:, 1 : 1 + m]
            b = self.gradient[row + 1] - ET @ solved[:, 0]
        return D, C, G, b, c

    def _damped_diagonal(self, row: int, damping: float) -> Array:
        D: Array = self.diagonal[row] + damping * np.diag(np.diag(self.diagonal[row]))
        return D


def _bias_prior() -> Array:
    """Return the prior standard deviations ``(6,)`` of the biases at the first pose, gyroscope first."""
    return np.repeat([_GYRO_BIAS_PRIOR_RAD_S, _ACCEL_BIAS_PRIOR_M_S2], 3)


def _tangents(gravity: Array) -> Array:
    """Return two unit vectors ``(3, 2)`` perpendicular to gravity and to each other."""
    unit = gravity / np.linalg.norm(gravity)
    helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
    first = np.cross(unit, helper)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(unit, first)])


def _huber_weights(residuals: Array) -> Array:
    """Return the Huber weights ``(n, k)`` of whitened residuals ``(n, k)``, equal for the axes of a vector.

    Each three successive columns are the components of one vector.
    """
    norms = np.linalg.norm(residuals.reshape(len(residuals), -1, 3), axis=2) / np.sqrt(3.0)
    weights: Array = np.repeat(np.minimum(1.0, _HUBER_WIDTH / np.maximum(norms, 1e-12)), 3, axis=1)
    return weights


def _huber_cost(residuals: Array) -> Array:
    """Return the Huber loss ``(n, k / 3)`` of whitened residuals ``(n, k)``, one per group of 3 axes."""
    squared = np.square(residuals.reshape(len(residuals), -1, 3)).sum(axis=2)
    norms = np.sqrt(squared / 3.0)
    linear = 3.0 * (2.0 * _HUBER_WIDTH * norms - _HUBER_WIDTH**2)
    cost: Array = np.where(norms <= _HUBER_WIDTH, squared, linear)
    return cost
