"""Metres, gravity, velocities and biases of a drive, from the poses of its camera and from its IMU.

The poses may be up to scale.  They are measurements with noise: the smoothed poses agree with both.
Source of the first solution: Qin et al., "VINS-Mono", T-RO 2018, Sect. V-B; of the problem: Campos et al.,
"Inertial-Only Optimization for Visual-Inertial Initialization", ICRA 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from client_sdk.imu.checks import GRAVITY_M_S2, MOST_OFF_M_S2, off_gravity
from client_sdk.imu.preintegration import Preintegration
from client_sdk.imu.samples import ImuModel
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_so3, left_jacobian_so3, log_so3, right_jacobian_so3, skew

__all__ = ["GRAVITY_M_S2", "Alignment", "align", "bias_of_gyro"]

_STATE = 15
_T, _P, _V, _BG, _BA = (slice(3 * number, 3 * number + 3) for number in range(5))
_GYRO_PRIOR, _ACCEL_PRIOR = 0.1, 0.2
"""Deviations of biases before anything is measured: rad/s, m/s^2."""
_HUBER = 3.0
"""In standard deviations of each axis."""
_BEYOND_DOUBT = 10.0
_ITERATIONS, _CONVERGED, _MAX_DAMPING = 12, 1e-4, 1e8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """What an IMU and the poses of a camera tell together.

    Attributes:
        scale: Metres per unit of the poses.
        scale_deviation: Standard deviation of its logarithm: a share of it.
        gravity: ``(3,)`` m/s^2 in the world of the poses; it points down.
        gravity_deviation: Standard deviation of its direction, rad, the larger of both axes.
        R_world_imu: ``(n, 3, 3)``, smoothed.
        positions_m: ``(n, 3)`` of the IMU, metres, smoothed.
        velocities: ``(n, 3)`` m/s.
        bias_gyro: ``(n, 3)`` rad/s.
        bias_accel: ``(n, 3)`` m/s^2.
        bias_covariance: ``(6, 6)`` of the last biases of gyroscope and accelerometer.
        misfit: Root of the squared residuals per degree of freedom, about 1 if the noise is as stated; all
            deviations have been multiplied by what is above 1.
    """

    scale: float
    scale_deviation: float
    gravity: Array
    gravity_deviation: float
    R_world_imu: Array
    positions_m: Array
    velocities: Array
    bias_gyro: Array
    bias_accel: Array
    bias_covariance: Array
    misfit: float


def bias_of_gyro(R_world_imu: Array, motions: Sequence[Preintegration]) -> Array:
    """Return the ``(3,)`` bias of the gyroscope that fits the rotations ``(n, 3, 3)`` of tracked poses best.

    Source:
        VINS-Mono, eq. 15.
    """
    measured = np.stack([motion.rotation for motion in motions])
    J = np.stack([motion.jacobian[:3, :3] for motion in motions])
    turned = np.swapaxes(R_world_imu[:-1], 1, 2) @ R_world_imu[1:]
    differences = log_so3(np.swapaxes(measured, 1, 2) @ turned)
    JT = np.swapaxes(J, 1, 2)
    more = np.linalg.solve((JT @ J).sum(axis=0), np.einsum("nij,nj->i", JT, differences))
    bias: Array = motions[0].bias_gyro + more
    return bias


def align(
    T_world_camera: Array,
    motions: Sequence[Preintegration],
    model: ImuModel,
    pose_noise: tuple[float, float],
    *,
    is_metric: bool = False,
) -> Alignment | None:
    """Return the alignment of poses and preintegrated motions; None if they do not tell the scale.

    Args:
        T_world_camera: ``(n, 4, 4)``, n >= 5; translations in any unit, or in metres.
        motions: ``n - 1``, each between two neighbours of the poses.
        model: Of the IMU.
        pose_noise: Standard deviations of a pose: rad, and units of the poses.
        is_metric: Whether the poses are in metres.

    Raises:
        UsageError: The scale is below 0 beyond doubt: what is measured points the wrong way.
    """
    bias = bias_of_gyro(T_world_camera[:, :3, :3] @ model.T_imu_camera[:3, :3].T, motions)
    first = _linear(T_world_camera, motions, model, bias, is_metric=is_metric)
    if first is None:
        return None
    scale, gravity, velocities = first
    return _Problem(T_world_camera, motions, model, pose_noise, is_metric=is_metric).solve(
        scale, gravity, velocities, bias
    )


def _linear(
    T_world_camera: Array, motions: Sequence[Preintegration], model: ImuModel, bias_gyro: Array,
    *, is_metric: bool,
) -> tuple[float, Array, Array] | None:  # fmt: skip
    """Return scale, gravity and velocities of the linear problem; None if the scale is not above 0.

    Gravity is of any length in it, and the accelerometer has no bias.
    """
    R, arm = _imu_rotations(T_world_camera, model)
    p = T_world_camera[:, :3, 3]
    n = len(R)
    dt = np.array([motion.duration_s for motion in motions])
    A, b = np.zeros((n - 1, 6, 3 * n + 4)), np.zeros((n - 1, 6))
    more = bias_gyro - np.stack([motion.bias_gyro for motion in motions])
    J = np.stack([motion.jacobian[3:, :3] for motion in motions])
    moved = _moved(motions) + np.einsum("nij,nj->ni", J, more)
    for row in range(n - 1):
        here, after = slice(3 * row, 3 * row + 3), slice(3 * row + 3, 3 * row + 6)
        A[row, :3, here], A[row, :3, after] = -np.eye(3), np.eye(3)
        A[row, :3, 3 * n : 3 * n + 3] = -dt[row] * np.eye(3)
        A[row, 3:, here] = -dt[row] * np.eye(3)
        A[row, 3:, 3 * n : 3 * n + 3] = -0.5 * dt[row] ** 2 * np.eye(3)
        A[row, 3:, -1] = p[row + 1] - p[row]
        b[row, :3] = R[row] @ moved[row, :3]
        b[row, 3:] = R[row] @ moved[row, 3:] + (R[row + 1] - R[row]) @ arm
    matrix, right = A.reshape(-1, 3 * n + 4), b.ravel()
    if is_metric:
        right, matrix = right - matrix[:, -1], matrix[:, :-1]
    found = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], dtype=np.float64)
    scale = 1.0 if is_metric else float(found[-1])
    gravity: Array = found[3 * n : 3 * n + 3]
    length = float(np.linalg.norm(gravity))
    if not is_metric and scale < 0.0:
        deviations = _last_deviations(matrix, right - matrix @ found, 1)
        if -scale > _BEYOND_DOUBT * deviations[0]:
            raise UsageError(
                "the accelerometer measures the opposite of how the camera moves: an axis has the wrong sign",
                hint="a resting accelerometer points up with 9.81; see T_imu_camera",
            )
    if not scale > 0.0 or not length > 0.0:
        return None
    if abs(length - GRAVITY_M_S2) > MOST_OFF_M_S2:
        deviations = _last_deviations(matrix, right - matrix @ found, 3 if is_metric else 4)
        if abs(length - GRAVITY_M_S2) - MOST_OFF_M_S2 > _BEYOND_DOUBT * deviations[:3].max():
            raise UsageError(
                off_gravity(length, "of gravity beside the camera"),
                hint="calibrate the accelerometer; at rest it must read 9.81 m/s^2",
            )
    gravity = gravity * (GRAVITY_M_S2 / length)
    velocities: Array = found[: 3 * n].reshape(n, 3)
    return scale, gravity, velocities


def _last_deviations(matrix: Array, residuals: Array, count: int) -> Array:
    """Return the ``(count,)`` standard deviations of the last unknowns of a linear problem."""
    left = np.square(residuals).sum() / max(1, len(residuals) - matrix.shape[1])
    # The last rows of R, as the QR decomposition leaves it, hold these unknowns alone.
    R = np.asarray(np.linalg.qr(matrix, mode="r"))[-count:, -count:]
    if not np.abs(np.diag(R)).min() > 0.0:
        return np.full(count, np.inf)
    deviations: Array = np.sqrt(left * np.square(np.linalg.inv(R)).sum(axis=1))
    return deviations


def _moved(motions: Sequence[Preintegration]) -> Array:
    """Return velocity and position of each motion, ``(n, 6)``."""
    return np.stack([np.concatenate([motion.velocity, motion.position]) for motion in motions])


def _imu_rotations(T_world_camera: Array, model: ImuModel) -> tuple[Array, Array]:
    """Return ``R_world_imu`` of each pose, and the position of the camera in the frame of the IMU."""
    R: Array = T_world_camera[:, :3, :3] @ model.T_imu_camera[:3, :3].T
    return R, model.T_imu_camera[:3, 3]


class _Problem:
    """Least squares over rotations, positions, velocities and biases of all poses, scale and gravity.

    The states of neighbours alone are coupled, and all with scale and gravity: the matrix is block
    tridiagonal with a border, and solved in time proportional to the number of poses.
    """

    def __init__(
        self, T_world_camera: Array, motions: Sequence[Preintegration], model: ImuModel,
        pose_noise: tuple[float, float], *, is_metric: bool,
    ) -> None:  # fmt: skip
        self._seen_R, self._arm = _imu_rotations(T_world_camera, model)
        self._seen = T_world_camera[:, :3, 3]
        self._noise = pose_noise
        self._is_metric = is_metric
        self._dt = np.array([motion.duration_s for motion in motions])
        self._rotation = np.stack([motion.rotation for motion in motions])
        self._moved = _moved(motions)
        self._J = np.stack([motion.jacobian for motion in motions])
        self._at = np.stack([np.concatenate([motion.bias_gyro, motion.bias_accel]) for motion in motions])
        walk = np.repeat([model.gyro_walk, model.accel_walk], 3) ** 2
        self._whiten = np.zeros((len(motions), 15, 15))
        for row, motion in enumerate(motions):
            covariance = motion.covariance + 1e-14 * np.eye(9)
            self._whiten[row, :9, :9] = np.linalg.inv(np.linalg.cholesky(covariance))
            self._whiten[row, 9:, 9:] = np.diag(1.0 / np.sqrt(walk * motion.duration_s))

    def solve(self, scale: float, gravity: Array, velocities: Array, bias_gyro: Array) -> Alignment | None:
        """Return the best states from a first solution on, by Levenberg and Marquardt with Huber weights."""
        n = len(self._seen)
        state = _State(
            R=self._seen_R.copy(), p=scale * self._seen - self._seen_R @ self._arm, v=velocities.copy(),
            biases=np.tile(np.concatenate([bias_gyro, np.zeros(3)]), (n, 1)), scale=scale, gravity=gravity,
        )  # fmt: skip
        cost, damping = self._cost(state), 1e-5
        system = self._linearised(state)
        for _ in range(_ITERATIONS):
            is_better = False
            while damping < _MAX_DAMPING:
                moved = state.moved(*system.step(damping))
                moved_cost = self._cost(moved)
                if moved_cost < cost:
                    is_better = True
                    break
                damping *= 10.0
            if not is_better:
                break
            is_done = cost - moved_cost < _CONVERGED * cost
            state, cost, damping = moved, moved_cost, max(0.1 * damping, 1e-9)
            system = self._linearised(state)
            if is_done:
                break
        return self._alignment(state, system)

    def _alignment(self, state: _State, system: _System) -> Alignment | None:
        covariance = system.last_covariance()
        if covariance is None or not np.isfinite(covariance).all():
            return None
        inertial, seen = self._residuals(state)
        free = inertial.size + seen.size + 6 - _STATE * len(seen) - len(system.c)
        misfit = float(np.sqrt((np.square(inertial).sum() + np.square(seen).sum()) / free))
        covariance *= max(1.0, misfit) ** 2
        biases = covariance[_BG.start : _BA.stop, _BG.start : _BA.stop]
        tilt = covariance[_STATE + 1 :, _STATE + 1 :] if not self._is_metric else covariance[_STATE:, _STATE:]
        return Alignment(
            scale=state.scale,
            scale_deviation=0.0 if self._is_metric else float(np.sqrt(covariance[_STATE, _STATE])),
            gravity=state.gravity,
            gravity_deviation=float(np.sqrt(np.linalg.eigvalsh(tilt)[-1])),
            R_world_imu=state.R, positions_m=state.p, velocities=state.v,
            bias_gyro=state.biases[:, :3], bias_accel=state.biases[:, 3:], bias_covariance=biases,
            misfit=misfit,
        )  # fmt: skip

    def _cost(self, state: _State) -> float:
        inertial, seen = self._residuals(state)
        prior = (state.biases[0] / _bias_prior()) ** 2
        return float(_huber_cost(inertial).sum() + _huber_cost(seen).sum() + prior.sum())

    def _residuals(self, state: _State) -> tuple[Array, Array]:
        """Return the whitened residuals of motions ``(n - 1, 15)`` and of poses ``(n, 6)``."""
        raw, _ = self._raw(state)
        inertial = np.einsum("nij,nj->ni", self._whiten, raw)
        turned = log_so3(np.swapaxes(self._seen_R, 1, 2) @ state.R) / self._noise[0]
        apart = (state.p + state.R @ self._arm - state.scale * self._seen) / (self._noise[1] * state.scale)
        return inertial, np.concatenate([turned, apart], axis=1)

    def _raw(self, state: _State) -> tuple[Array, Array]:
        """Return the residuals of motions, and how the changed bias turns them ``(n - 1, 3)``."""
        RT = np.swapaxes(state.R[:-1], 1, 2)
        more = state.biases[:-1] - self._at
        by_bias = np.einsum("nij,nj->ni", self._J, more)
        raw = np.empty((len(self._dt), 15))
        expected = self._rotation @ exp_so3(by_bias[:, :3])
        raw[:, :3] = log_so3(np.swapaxes(expected, 1, 2) @ RT @ state.R[1:])
        moved = self._moved + by_bias[:, 3:]
        raw[:, 3:6] = np.einsum("nij,nj->ni", RT, self._gained(state)) - moved[:, :3]
        raw[:, 6:9] = np.einsum("nij,nj->ni", RT, self._passed(state)) - moved[:, 3:]
        raw[:, 9:] = state.biases[1:] - state.biases[:-1]
        return raw, by_bias[:, :3]

    def _gained(self, state: _State) -> Array:
        gained: Array = state.v[1:] - state.v[:-1] - self._dt[:, None] * state.gravity
        return gained

    def _passed(self, state: _State) -> Array:
        dt = self._dt[:, None]
        passed: Array = state.p[1:] - state.p[:-1] - dt * state.v[:-1] - 0.5 * dt**2 * state.gravity
        return passed

    def _linearised(self, state: _State) -> _System:
        """Return the normal equations at a state; Jacobians after Forster et al. 2017, appendix C."""
        n, m = len(self._seen), 2 if self._is_metric else 3
        raw, by_bias = self._raw(state)
        RT = np.swapaxes(state.R[:-1], 1, 2)
        dt = self._dt[:, None, None]
        back = np.asarray(np.linalg.inv(right_jacobian_so3(raw[:, :3])), dtype=np.float64)
        first, second = np.zeros((n - 1, 15, 15)), np.zeros((n - 1, 15, 15))
        border = np.zeros((n - 1, 15, m))
        first[:, _T, _T] = -back @ np.swapaxes(state.R[1:], 1, 2) @ state.R[:-1]
        second[:, _T, _T] = back
        # Log(Exp(-J d) Exp(r)): the bias turns on the left, by the inverse of the left Jacobian.
        first[:, _T, _BG] = (
            -np.linalg.inv(left_jacobian_so3(raw[:, :3])) @ right_jacobian_so3(by_bias) @ self._J[:, :3, :3]
        )
        first[:, 3:6, _T] = skew(np.einsum("nij,nj->ni", RT, self._gained(state)))
        first[:, 6:9, _T] = skew(np.einsum("nij,nj->ni", RT, self._passed(state)))
        first[:, 3:6, _V], second[:, 3:6, _V] = -RT, RT
        first[:, 6:9, _P], second[:, 6:9, _P], first[:, 6:9, _V] = -RT, RT, -dt * RT
        first[:, 3:9, 9:] = -self._J[:, 3:]
        first[:, 9:, 9:], second[:, 9:, 9:] = -np.eye(6), np.eye(6)
        tilt = -skew(state.gravity) @ _tangents(state.gravity)
        border[:, 3:6, m - 2 :] = -dt * RT @ tilt
        border[:, 6:9, m - 2 :] = -0.5 * dt**2 * RT @ tilt
        inertial, seen = self._residuals(state)
        weights = np.sqrt(_huber_weights(inertial))[:, :, None]
        first, second, border = (weights * (self._whiten @ each) for each in (first, second, border))
        inertial = weights[:, :, 0] * inertial
        # Of the poses that were seen.
        own, own_border = np.zeros((n, 6, 15)), np.zeros((n, 6, m))
        own[:, :3, _T] = np.linalg.inv(right_jacobian_so3(seen[:, :3] * self._noise[0])) / self._noise[0]
        far = self._noise[1] * state.scale
        own[:, 3:, _T] = -state.R @ skew(self._arm) / far
        own[:, 3:, _P] = np.eye(3) / far
        if not self._is_metric:
            own_border[:, 3:, 0] = -state.scale * self._seen / far
        weights = np.sqrt(_huber_weights(seen))[:, :, None]
        own, own_border, seen = weights * own, weights * own_border, weights[:, :, 0] * seen
        system = _System(n, m)
        system.add(own, own_border, seen)
        system.add_pairs(first, second, border, inertial)
        information = 1.0 / _bias_prior() ** 2
        system.D[0, 9:, 9:] += np.diag(information)
        system.b[0, 9:] += information * state.biases[0]
        return system


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    R: Array
    p: Array
    v: Array
    biases: Array
    scale: float
    gravity: Array

    def moved(self, steps: Array, shared: Array) -> _State:
        """Return the state after ``(n, 15)`` steps, and those of scale, if there is one, and gravity."""
        scale = self.scale * float(np.exp(shared[0])) if len(shared) == 3 else self.scale
        turn = exp_so3(_tangents(self.gravity) @ shared[-2:])
        return _State(
            R=self.R @ exp_so3(steps[:, _T]), p=self.p + steps[:, _P], v=self.v + steps[:, _V],
            biases=self.biases + steps[:, 9:], scale=scale, gravity=turn @ self.gravity,
        )  # fmt: skip


class _System:
    """Normal equations: blocks ``D`` on the diagonal, ``E`` beside it, the border ``C``, and ``G`` of it."""

    def __init__(self, n: int, m: int) -> None:
        self.D, self.E = np.zeros((n, _STATE, _STATE)), np.zeros((n - 1, _STATE, _STATE))
        self.C, self.G = np.zeros((n, _STATE, m)), np.zeros((m, m))
        self.b, self.c = np.zeros((n, _STATE)), np.zeros(m)

    def add(self, J: Array, border: Array, residuals: Array) -> None:
        """Add residuals ``(n, k)`` of each state alone."""
        JT, borderT = np.swapaxes(J, 1, 2), np.swapaxes(border, 1, 2)
        self.D += JT @ J
        self.C += JT @ border
        self.b += np.einsum("nij,nj->ni", JT, residuals)
        self.G += (borderT @ border).sum(axis=0)
        self.c += np.einsum("nij,nj->i", borderT, residuals)

    def add_pairs(self, first: Array, second: Array, border: Array, residuals: Array) -> None:
        """Add residuals ``(n - 1, k)`` of neighbours."""
        firstT, secondT, borderT = (np.swapaxes(each, 1, 2) for each in (first, second, border))
        self.D[:-1] += firstT @ first
        self.D[1:] += secondT @ second
        self.E += firstT @ second
        self.C[:-1] += firstT @ border
        self.C[1:] += secondT @ border
        self.b[:-1] += np.einsum("nij,nj->ni", firstT, residuals)
        self.b[1:] += np.einsum("nij,nj->ni", secondT, residuals)
        self.G += (borderT @ border).sum(axis=0)
        self.c += np.einsum("nij,nj->i", borderT, residuals)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the steps of the states ``(n, 15)`` and of the border ``(m,)``."""
        found, G, c = self._eliminated(damping)
        n = len(self.D)
        shared = np.asarray(np.linalg.solve(G, -c), dtype=np.float64)
        steps = np.empty((n, _STATE))
        after = np.zeros(_STATE)
        for row in range(n - 1, -1, -1):
            solved = found[row]
            steps[row] = -solved[:, 0] - solved[:, 1 : 1 + len(shared)] @ shared
            if row < n - 1:
                steps[row] -= solved[:, 1 + len(shared) :] @ after
            after = steps[row]
        return steps, shared

    def last_covariance(self) -> Array | None:
        """Return the covariance of the last state and the border, ``(15 + m, 15 + m)``; None if singular."""
        D, C, G, _, _ = self._forward(0.0)
        whole = np.block([[D, C], [C.T, G]])
        try:
            made: Array = np.linalg.inv(whole)
        except np.linalg.LinAlgError:
            return None
        return made if (np.diag(made) > 0.0).all() else None

    def _eliminated(self, damping: float) -> tuple[list[Array], Array, Array]:
        found: list[Array] = []
        D, C, G, b, c = self._forward(damping, found)
        solved = np.asarray(np.linalg.solve(D, np.column_stack([b, C])), dtype=np.float64)
        found.append(solved)
        return found, G - C.T @ solved[:, 1:], c - C.T @ solved[:, 0]

    def _forward(
        self, damping: float, found: list[Array] | None = None
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Eliminate all states but the last; return its block, its border, that of the border, both sides."""
        n, m = len(self.D), len(self.c)
        G, c = self.G + damping * np.diag(np.diag(self.G)), self.c.copy()
        D, C, b = self._damped(0, damping), self.C[0], self.b[0]
        for row in range(n - 1):
            E = self.E[row]
            solved = np.asarray(np.linalg.solve(D, np.column_stack([b, C, E])), dtype=np.float64)
            if found is not None:
                found.append(solved)
            ET, CT = E.T, C.T
            G, c = G - CT @ solved[:, 1 : 1 + m], c - CT @ solved[:, 0]
            D = self._damped(row + 1, damping) - ET @ solved[:, 1 + m :]
            C, b = self.C[row + 1] - ET @ solved[:, 1 : 1 + m], self.b[row + 1] - ET @ solved[:, 0]
        return D, C, G, b, c

    def _damped(self, row: int, damping: float) -> Array:
        D: Array = self.D[row] + damping * np.diag(np.diag(self.D[row]))
        return D


def _bias_prior() -> Array:
    return np.repeat([_GYRO_PRIOR, _ACCEL_PRIOR], 3)


def _tangents(gravity: Array) -> Array:
    """Return two unit vectors ``(3, 2)`` across gravity."""
    unit = gravity / np.linalg.norm(gravity)
    helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
    one = np.cross(unit, helper)
    one /= np.linalg.norm(one)
    return np.column_stack([one, np.cross(unit, one)])


def _huber_weights(residuals: Array) -> Array:
    """Return the weights of groups of three numbers, repeated for each number."""
    norms = np.linalg.norm(residuals.reshape(len(residuals), -1, 3), axis=2) / np.sqrt(3.0)
    weights: Array = np.repeat(np.minimum(1.0, _HUBER / np.maximum(norms, 1e-12)), 3, axis=1)
    return weights


def _huber_cost(residuals: Array) -> Array:
    squared = np.square(residuals.reshape(len(residuals), -1, 3)).sum(axis=2)
    norms = np.sqrt(squared / 3.0)
    cost: Array = np.where(norms <= _HUBER, squared, 3.0 * (2.0 * _HUBER * norms - _HUBER**2))
    return cost
