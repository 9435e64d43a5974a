"""Estimate metric scale, gravity, velocities and biases from the poses of a camera and its IMU.

The camera's poses, which may be up to scale, are measurements with noise (a loosely coupled problem):

1. The bias of the gyroscope follows from the rotations of the poses (VINS-Mono, eq. 15).
2. A linear problem gives velocities, gravity and scale (VINS-Mono, Sect. V-B).  If the scale is certainly
   negative, or the magnitude of gravity certainly wrong, the accelerometer is refused.  Then the magnitude of
   gravity is set to 9.81 m/s^2.
3. A nonlinear least-squares problem refines velocities, gravity and scale together with the rotations,
   positions and biases of all poses: residuals of preintegrated motions (Forster et al. 2017) and of poses,
   Huber loss, Levenberg-Marquardt.  Each pose has biases of its own.

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

_GYRO_BIAS_PRIOR_RAD_S = 0.1  # prior standard deviation of each axis of the gyroscope's bias
_ACCEL_BIAS_PRIOR_M_S2 = 0.2  # prior standard deviation of each axis of the accelerometer's bias
_HUBER_WIDTH = 3.0
"""Width of the Huber loss in standard deviations.  The residual of a vector has three whitened components;
its loss is quadratic up to this root mean square of the components, and linear beyond, so that outliers count
less."""
_CERTAIN_DEVIATIONS = 10.0
"""The linear solution raises an error of the accelerometer only if its scale is below 0, or its magnitude of
gravity beyond the allowed error, by more than this many of their own standard deviations: a short drive
proves neither."""
_MAX_ITERATIONS = 12  # largest number of accepted Levenberg-Marquardt steps of one alignment
_CONVERGED_FRACTION = 1e-4
"""Levenberg-Marquardt ends after a step that lowers the cost by less than this fraction of the cost."""
_FIRST_DAMPING = 1e-5
"""Levenberg-Marquardt damping of the first step, as the fraction of each diagonal element that is added to
it.  A step that does not lower the cost multiplies the damping by 10, a step that does by 0.1."""
_MIN_DAMPING = 1e-9  # smallest Levenberg-Marquardt damping of a step
_MAX_DAMPING = 1e8  # damping above which Levenberg-Marquardt ends: no step lowers the cost any more
_COVARIANCE_FLOOR = 1e-14  # added to variances of preintegrated motions, so that a Cholesky factor exists


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuAlignment:
    """Metric scale, gravity and biases that agree with the poses of a camera and the samples of its IMU.

    Attributes:
        scale: Metres per unit of the camera's poses.
        scale_deviation: Standard deviation of the scale divided by the scale; 0 for metric poses.
        gravity_m_s2: ``(3,)`` in the world of the poses; it points down, and its length is 9.81.
        gravity_deviation_rad: Standard deviation of the direction of gravity, about the horizontal axis about
            which it is less certain.
        gyro_bias_rad_s: ``(3,)`` bias of the gyroscope at the last pose.
        accel_bias_m_s2: ``(3,)`` bias of the accelerometer at the last pose.
        misfit: Square root of the chi-square per degree of freedom of all residuals: about 1 if poses and IMU
            have the stated noise.  If it is above 1, *scale_deviation* and *gravity_deviation_rad* are those
            of the stated noise multiplied by it.
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

    The n - 1 motions lie between successive rotations.  The result is the bias with which the first motion
    was preintegrated plus one step of linear least squares, so all motions must have been preintegrated with
    nearly the same bias.

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
        motions: n - 1 preintegrated motions, each between two successive poses.
        model: Model of the IMU.
        pose_noise: Standard deviations of a pose's rotation (rad) and position (unit of the poses).
        is_metric: Whether the unit of the poses is the metre; the scale is then fixed at 1.

    Raises:
        UsageError: The scale is below 0 by more than ten standard deviations, so the accelerometer has the
            wrong sign; or the magnitude of gravity differs from 9.81 m/s^2 by more than 0.6 m/s^2 plus ten
            standard deviations, so the accelerometer has the wrong scale or too large a bias.
    """
    problem = _AlignmentProblem(T_world_camera, motions, model, pose_noise, is_metric=is_metric)
    gyro_bias = estimate_gyro_bias(problem.observed_R, motions)
    linear_solution = problem.solve_linearly(gyro_bias)
    return None if linear_solution is None else problem.refine(*linear_solution, gyro_bias)


def _deviations_of_last(matrix: Array, residuals: Array, count: int) -> Array:
    """Return the ``(count,)`` standard deviations of the last unknowns of a linear least-squares problem.

    The variance of the noise is the mean square of the *residuals*.  All deviations are infinite if the
    equations *matrix* do not determine these unknowns.
    """
    variance = np.square(residuals).sum() / max(1, len(residuals) - matrix.shape[1])
    # The last rows of R in the QR decomposition are equations of the last unknowns alone.
    R = np.asarray(np.linalg.qr(matrix, mode="r"))[-count:, -count:]
    if not np.abs(np.diag(R)).min() > 0.0:
        return np.full(count, np.inf)
    deviations: Array = np.sqrt(variance * np.square(np.linalg.inv(R)).sum(axis=1))
    return deviations


class _AlignmentProblem:
    """Nonlinear least squares over the states of all poses, the scale, and the direction of gravity.

    A residual depends on the states of at most two successive poses, and on the scale and gravity.  The
    normal equations are therefore block tridiagonal with a border (rows and columns of scale and gravity),
    and are solved in time proportional to the number of poses.
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
        # Square roots of the information matrices: 9x9 of the motions, then 6x6 of the biases' random walk.
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
        # 1. Correct the preintegrated velocities and positions for the change of the gyroscope bias.
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
        # 4. Refuse an accelerometer with a certainly negative scale, or a certainly wrong magnitude of
        #    gravity.
        if not self._is_metric and scale < 0.0:
            deviations = _deviations_of_last(matrix, right - matrix @ solution, 1)
            if -scale > _CERTAIN_DEVIATIONS * deviations[0]:
                raise UsageError(
                    "the accelerometer measures the opposite of how the camera moves: at least one axis has "
                    "the wrong sign",
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

        The arguments are the result of `solve_linearly`, and the ``(3,)`` gyroscope bias.  The result is None
        if the final equations are singular, or give a variance that is not positive.
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
        """Return the alignment at *state*, with deviations from the inverse of the normal equations.

        None if these are singular, or give a variance that is not positive.
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

        Those of a motion are in the order of `_motion_residuals`; those of a pose are three of its rotation,
        then three of the camera's position.
        """
        raw, _ = self._motion_residuals(state)
        motion_residuals = np.einsum("nij,nj->ni", self._sqrt_information, raw)
        rotations = log_so3(np.swapaxes(self.observed_R, 1, 2) @ state.R) / self._rotation_noise
        camera_positions = state.p + state.R @ self._camera_in_imu
        positions = (camera_positions - state.scale * self._observed_p) / (self._position_noise * state.scale)
        return motion_residuals, np.concatenate([rotations, positions], axis=1)

    def _motion_residuals(self, state: _State) -> tuple[Array, Array]:
        """Return residuals of motions ``(n - 1, 15)`` before whitening, and corrections of their rotations.

        The residuals of a motion are three each of the rotation (rad), velocity (m/s) and position (m), then
        six of the change of the biases from its first pose to its second.

        A motion was preintegrated with other biases than those of *state*.  The preintegrated rotation for
        the gyroscope bias of *state* is ``delta_rotation @ Exp(J (bias - preintegrated bias))``, with the
        derivative J of the rotation by this bias.  The argument of Exp, a rotation vector in rad, is the
        correction; those of all motions are ``(n - 1, 3)``.
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
        """Return ``v_j - v_i - g dt`` of each motion ``(n - 1, 3)`` in the world, m/s."""
        changes: Array = state.v[1:] - state.v[:-1] - self._dt[:, None] * state.gravity
        return changes

    def _position_changes(self, state: _State) -> Array:
        """Return ``p_j - p_i - v_i dt - g dt^2 / 2`` of each motion ``(n - 1, 3)`` in the world, metres."""
        dt = self._dt[:, None]
        changes: Array = state.p[1:] - state.p[:-1] - dt * state.v[:-1] - 0.5 * dt**2 * state.gravity
        return changes

    def _linearise(self, state: _State) -> _NormalEquations:
        """Return the normal equations at a state, with the weights of the Huber loss.

        The unknowns of the border are the logarithm of the scale (unless the poses are metric) and two
        angles, in rad, by which gravity rotates about its `_tangents`.

        Source:
            Jacobians of preintegrated motions: Forster et al. 2017, appendix C.
        """
        n, border_size = len(self._observed_p), 2 if self._is_metric else 3
        # 1. Differentiate the residuals of each motion by the state of its first pose (before), by that of
        #    its second pose (after), and by the border.
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
        # A change d of the gyroscope bias turns the rotation residual r (a rotation vector) into
        # Log(Exp(-J d) Exp(r)), where J is the derivative of the preintegrated rotation by the bias.  The
        # change is a factor on the left, so that the inverse left Jacobian is needed.
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

        The step of a rotation is a rotation vector, and is multiplied on the right.  The last two numbers of
        the border are the angles, rad, by which gravity rotates about its two `_tangents`; the first of three
        is the change of the logarithm of the scale.
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

    A state holds the 15 unknowns of one pose: rotation, position, velocity and both biases.  The border holds
    the m unknowns that all poses share: two angles of gravity, and the logarithm of the scale unless the
    poses are metric.  For n states: ``diagonal`` ``(n, 15, 15)``, ``coupling`` ``(n - 1, 15, 15)`` of each
    state with the next, ``border`` ``(n, 15, m)`` of each state with the border, ``corner`` ``(m, m)`` of the
    border with itself, and the gradients (Jacobian transposed times residuals) ``(n, 15)`` and ``(m,)``.
    """

    def __init__(self, n: int, m: int) -> None:
        self.diagonal = np.zeros((n, _STATE_SIZE, _STATE_SIZE))
        self.coupling = np.zeros((n - 1, _STATE_SIZE, _STATE_SIZE))
        self.border, self.corner = np.zeros((n, _STATE_SIZE, m)), np.zeros((m, m))
        self.gradient, self.border_gradient = np.zeros((n, _STATE_SIZE)), np.zeros(m)

    def add(self, rows: slice, J: Array, border: Array, residuals: Array) -> None:
        """Add the terms of k *residuals* of each of the states *rows* to the equations of these states.

        *J* ``(rows, k, 15)`` and *border* ``(rows, k, m)`` are the Jacobians of the *residuals* ``(rows, k)``
        by these states and by the border.
        """
        JT = np.swapaxes(J, 1, 2)
        self.diagonal[rows] += JT @ J
        self.border[rows] += JT @ border
        self.gradient[rows] += np.einsum("nij,nj->ni", JT, residuals)

    def add_border(self, border: Array, residuals: Array) -> None:
        """Add the terms of *residuals*, with the Jacobian *border*, to ``corner`` and ``border_gradient``."""
        borderT = np.swapaxes(border, 1, 2)
        self.corner += (borderT @ border).sum(axis=0)
        self.border_gradient += np.einsum("nij,nj->i", borderT, residuals)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of the states ``(n, 15)`` and of the border ``(m,)`` that lower the cost.

        *damping* is the fraction of each diagonal element that is added to it for this solution; the stored
        equations do not change.
        """
        # 1. Eliminate the states of all poses (rotation, position, velocity and biases), so that equations of
        #    the border alone (the scale and the direction of gravity) remain.
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
        """Eliminate all states but the last one, from the first on.

        Return the equations that remain for the last state and the border: diagonal and border of the last
        state, the corner, and the gradients of the last state and of the border.

        For each eliminated state, the matrix ``inverse(D) [b, C, E]``, which back substitution needs, is
        appended to *eliminated*.  D, b, C and E are the diagonal, the gradient, the border and the coupling
        with the next state, after all earlier states were eliminated.
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
    """Return the prior standard deviations ``(6,)`` of the first pose's biases: gyroscope, accelerometer."""
    return np.repeat([_GYRO_BIAS_PRIOR_RAD_S, _ACCEL_BIAS_PRIOR_M_S2], 3)


def _tangents(gravity: Array) -> Array:
    """Return two unit vectors, the columns of ``(3, 2)``, perpendicular to gravity and to each other."""
    unit = gravity / np.linalg.norm(gravity)
    helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
    first = np.cross(unit, helper)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(unit, first)])


def _huber_weights(residuals: Array) -> Array:
    """Return the Huber weights ``(n, k)`` of whitened residuals ``(n, k)``.

    Each three successive columns are the components of one vector, which have the same weight.
    """
    norms = np.linalg.norm(residuals.reshape(len(residuals), -1, 3), axis=2) / np.sqrt(3.0)
    weights: Array = np.repeat(np.minimum(1.0, _HUBER_WIDTH / np.maximum(norms, 1e-12)), 3, axis=1)
    return weights


def _huber_cost(residuals: Array) -> Array:
    """Return the Huber loss ``(n, k / 3)`` of whitened residuals ``(n, k)``, one for each three columns."""
    squared = np.square(residuals.reshape(len(residuals), -1, 3)).sum(axis=2)
    norms = np.sqrt(squared / 3.0)
    linear = 3.0 * (2.0 * _HUBER_WIDTH * norms - _HUBER_WIDTH**2)
    cost: Array = np.where(norms <= _HUBER_WIDTH, squared, linear)
    return cost
