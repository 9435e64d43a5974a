"""Adjust the keyframes of a drive together with the calibration of their camera.

Gauss-Newton over poses, landmarks and calibration with robust weights; landmarks are eliminated by the Schur
complement.  What a value means for a user, and which matches are believed, is decided elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, DegenerateGeometry
from rse_pf.geometry import Array, Camera, exp_se3, inverse, skew
from rse_pf.slam.schur import NormalEquations, ReducedEquations

__all__ = [
    "UNKNOWNS",
    "Calibrated",
    "DriveObservations",
    "adjust_with_calibration",
    "deviations_of_parts",
    "rms_after_alignment",
    "triangulated",
]

Rows = npt.NDArray[np.int64]

UNKNOWNS = ("fx", "fy", "cx", "cy", "k1", "offset", "delay", "readout", "curve")
"""Logarithms of the ratios of focal lengths, pixels, radial distortion, metres that depth is too large and
seconds that it is late, seconds from the first row of a rolling shutter to the last, and metres that depth is
too large for each square metre of it."""
PRIOR = np.array([0.15, 0.15, 40.0, 40.0, 0.15, 0.15, 0.3, 0.02, 0.01])
"""Standard deviations of the unknowns before the drive is seen."""
_ZOOM_PRIOR = 0.15
_CAUCHY = 2.0
_ITERATIONS = 12  # steps of an adjustment
_ZOOM_ITERATIONS = 6  # steps with a focal length for each keyframe, which begin near the solution
_CONVERGED = 1e-4  # the adjustment ends when a step lowers the cost by less than this share
_FIRST_DAMPING = 1e-4  # Levenberg-Marquardt's share of the diagonal: nearly Gauss-Newton at first
_MOST_DAMPING = 1e4  # the adjustment ends when a step with more damping does not lower the cost
_NEAR_M = 0.02
_BEHIND = 1e3
_BLOCKS = 6  # stretches of a drive whose errors are taken as correlated
_CELLS = 6  # columns and rows of the image whose errors are taken as correlated
_MAD = 1.4826
_MOST_PARTS = 4  # parts of a drive that are adjusted by themselves
_LEAST_OF_PART = 6  # keyframes of a part
_MOST_TURN_RAD = 0.5  # largest rotation of a keyframe in one step; exp_se3 is far from linear beyond it
_MEAN_INFORMATION = 1e8  # of the mean of all zooms, which holds it at 0
_SAMPLES = 8
_POSE_INFORMATION = 1.0  # of each pose, far below that of a drive: fixes position, and scale without metres
_POINT_INFORMATION = 1e-3  # of each landmark, far below that of one pixel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveObservations:
    """Landmarks and where keyframes see them.

    Attributes:
        camera: Intrinsics as they are set.
        keyframes: ``(n,)``, row of the keyframe of each observation.
        landmarks: ``(n,)``, row of its landmark; a keyframe sees one at most once.
        pixels: ``(n, 2)``.
        pixels_px: ``(n,)`` deviations of the pixels.
        depths_m: ``(n,)`` along the optical axis, NaN where there is none.
        depths_dev_m: ``(n,)`` deviations of the depths; not read where there is none.
        rates_m_s: ``(n,)``, how the depth at the pixel changes with time; 0 where that is not known.
        twists_s: ``(k, 6)``, how the pose of each keyframe changes in a second, as a twist on its left; 0
            where that is not known.
        curve_dev_per_m: Deviation of the unknown ``curve`` before the drive is seen.
    """

    camera: Camera
    keyframes: Rows
    landmarks: Rows
    pixels: Array
    pixels_px: Array
    depths_m: Array
    depths_dev_m: Array
    rates_m_s: Array
    twists_s: Array
    curve_dev_per_m: float = float(PRIOR[-1])

    def __post_init__(self) -> None:
        n = len(self.keyframes)
        shapes = (
            self.landmarks.shape, self.pixels_px.shape, self.depths_m.shape, self.depths_dev_m.shape,
            self.rates_m_s.shape,
        )  # fmt: skip
        if shapes != ((n,),) * 5 or self.pixels.shape != (n, 2):
            raise BadRequest(
                "observations of different numbers of rows", hint="give one row for each observation"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibrated:
    """The result of `adjust_with_calibration`.

    Attributes:
        values: ``(9,)`` of `UNKNOWNS`; those that were not free are 0.
        covariance: ``(9, 9)`` of the values, inflated to what the residuals show.
        zooms: ``(k,)`` logarithms of the focal length of each keyframe beside the common one.
        zooms_covariance: ``(k, k)``.
        T_camera_world: ``(k, 4, 4)``.
        points_world: ``(l, 3)``.
        bends_m: ``(9, k, 3)``, how the keyframes' positions move where an unknown is held one too large.
        noise_m: How well the drive tells its positions: root mean square after alignment.
        cost: Robust sum of squares.
        has_metres: Whether depths tell the scale; else paths are compared up to scale.
        pixel_factor, depth_factor: Residuals against the deviations of the observations.
    """

    values: Array
    covariance: Array
    zooms: Array
    zooms_covariance: Array
    T_camera_world: Array
    points_world: Array
    bends_m: Array
    noise_m: float
    cost: float
    has_metres: bool
    pixel_factor: float
    depth_factor: float

    @property
    def deviations(self) -> Array:
        """``(9,)`` standard deviations of the values."""
        deviations: Array = np.sqrt(np.diag(self.covariance))
        return deviations

    def bend_m(self, error: Array) -> float:
        """Return how far a calibration that is wrong by *error* ``(9,)`` bends the drive, after alignment."""
        moved = np.tensordot(error, self.bends_m, axes=1)
        return rms_after_alignment(inverse(self.T_camera_world)[:, :3, 3], moved, has_metres=self.has_metres)


def triangulated(observed: DriveObservations, T_camera_world: Array, count: int) -> Array:
    """Return ``(count, 3)`` landmarks from depths where there are some, and from rays elsewhere."""
    camera, T = observed.camera, T_camera_world[observed.keyframes]
    rays = camera.back_project(observed.pixels, np.ones(len(T)))
    rotated = np.einsum("nji,nj->ni", T[:, :3, :3], rays)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    has_depth = np.isfinite(observed.depths_m)
    weight = np.where(has_depth, np.square(observed.depths_dev_m, where=has_depth, out=np.ones(len(T))), 1.0)
    points = centres + np.nan_to_num(observed.depths_m)[:, None] * rotated
    unit = rotated / np.linalg.norm(rotated, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    A = _summed(across, observed.landmarks, count)
    b = _summed(np.einsum("nij,nj->ni", across, centres), observed.landmarks, count)
    near: Array = np.where(has_depth, 1.0 / weight, 0.0)
    A += _summed(near[:, None, None] * np.eye(3), observed.landmarks, count)
    b += _summed(near[:, None] * points, observed.landmarks, count)
    found = np.linalg.solve(A + 1e-9 * np.eye(3), b[:, :, None])[:, :, 0]
    return found.astype(np.float64, copy=False)


def adjust_with_calibration(
    observed: DriveObservations, T_camera_world: Array, points_world: Array, free: tuple[str, ...],
    *, zooms: bool = False, values: Array | None = None,
) -> Calibrated:  # fmt: skip
    """Return poses, landmarks and calibration that agree best with pixels and depths.

    A pixel is ``f e^(a + zoom) x (1 + k1 r^2) + c + d``; a measured depth is
    ``z + offset + curve z^2 - rate * delay``.

    Args:
        observed: Of all keyframes.
        T_camera_world: ``(k, 4, 4)``, where the adjustment begins.
        points_world: ``(l, 3)``, as `triangulated` returns them.
        free: Which of `UNKNOWNS` are adjusted; the others are 0.
        zooms: Whether each keyframe has a focal length of its own.
        values: ``(9,)``, where the calibration begins; None for 0.

    Raises:
        DegenerateGeometry: The linear system has no solution.

    Source:
        Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6; deviations by the sandwich of
        White, Econometrica 1980, over stretches of the drive.
    """
    unknown = set(free) - set(UNKNOWNS)
    if unknown:
        raise BadRequest(f"no unknown named {sorted(unknown)}", hint=f"choose of {', '.join(UNKNOWNS)}")
    system = _System(observed, len(T_camera_world), len(points_world), free, zooms=zooms)
    begin = np.zeros(len(UNKNOWNS)) if values is None else values
    state = _State(T_camera_world.copy(), points_world.copy(), begin.copy(), np.zeros(system.k))

    damping = _FIRST_DAMPING
    system.rescale(state)
    cost = system.cost(state)
    try:
        for iteration in range(_ZOOM_ITERATIONS if zooms else _ITERATIONS):
            system.linearise(state)
            moved, moved_cost = state, np.inf
            while damping <= _MOST_DAMPING:
                moved = system.step(state, damping)
                moved_cost = system.cost(moved)
                if moved_cost < cost:
                    break
                damping *= 10.0
            if not moved_cost < cost:
                break
            is_done = cost - moved_cost < _CONVERGED * cost
            state, cost, damping = moved, moved_cost, max(damping * 0.1, 1e-9)
            if iteration in (1, 4):
                system.rescale(state)
                cost = system.cost(state)
            elif is_done and iteration > 4:
                break
        system.rescale(state)
        system.linearise(state)
        return system.result(state)
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometry(
            "the keyframes of this drive do not determine their poses",
            hint="move more, and past more texture",
        ) from error


def deviations_of_parts(observed: DriveObservations, found: Calibrated, free: tuple[str, ...]) -> Array:
    """Return ``(9,)`` deviations of the calibration from how far parts of a drive disagree about it.

    Parts that are adjusted by themselves disagree by more than their own deviations where the model lacks
    something, such as errors of depth that change with the scene.  0 where there are too few keyframes.

    Args:
        observed: As it was adjusted.
        found: The result for the whole drive.
        free: As it was adjusted.
    """
    k = len(found.T_camera_world)
    count = min(_MOST_PARTS, k // _LEAST_OF_PART)
    values, variances = [], []
    for part in range(count if count > 1 else 0):
        rows = np.arange(k * part // count, k * (part + 1) // count)
        try:
            own = adjust_with_calibration(*_part_of(observed, found, rows), free, values=found.values)
        except DegenerateGeometry:
            continue
        values.append(own.values)
        variances.append(np.diag(own.covariance))
    total: Array = np.zeros(len(UNKNOWNS))
    if len(values) < 2:
        return total
    at = [UNKNOWNS.index(name) for name in free]
    total[at] = disagreement(np.array(values)[:, at], np.array(variances)[:, at])
    return total


def disagreement(values: Array, variances: Array) -> Array:
    """Return by what parts disagree beyond their ``(p, n)`` variances: the ``(n,)`` deviation of the mean.

    Source:
        DerSimonian and Laird, Controlled Clinical Trials 1986, Sect. 2: the variance between studies.
    """
    w = 1.0 / np.maximum(variances, 1e-18)
    mean = (w * values).sum(axis=0) / w.sum(axis=0)
    excess = (w * (values - mean) ** 2).sum(axis=0) - (len(values) - 1)
    between = np.maximum(excess, 0.0) / (w.sum(axis=0) - (w**2).sum(axis=0) / w.sum(axis=0))
    deviations: Array = np.sqrt(between / len(values))
    return deviations


def _part_of(
    observed: DriveObservations, found: Calibrated, rows: Rows
) -> tuple[DriveObservations, Array, Array]:
    """Return what some keyframes see of the landmarks that two of them share, with where these are."""
    numbers = np.full(len(found.T_camera_world), -1)
    numbers[rows] = np.arange(len(rows))
    kept = numbers[observed.keyframes] >= 0
    kept &= np.bincount(observed.landmarks[kept], minlength=len(found.points_world))[observed.landmarks] > 1
    seen, landmarks = np.unique(observed.landmarks[kept], return_inverse=True)
    own = replace(
        observed, keyframes=numbers[observed.keyframes[kept]], landmarks=landmarks,
        pixels=observed.pixels[kept], pixels_px=observed.pixels_px[kept], depths_m=observed.depths_m[kept],
        depths_dev_m=observed.depths_dev_m[kept], rates_m_s=observed.rates_m_s[kept],
        twists_s=observed.twists_s[rows],
    )  # fmt: skip
    return own, found.T_camera_world[rows], found.points_world[seen]


@dataclass(frozen=True, slots=True)
class _State:
    T: Array
    points: Array
    values: Array
    zooms: Array


class _System:
    """The normal equations of a drive, with observations in the order of their landmarks."""

    def __init__(
        self,
        observed: DriveObservations,
        keyframes: int,
        landmarks: int,
        free: tuple[str, ...],
        *,
        zooms: bool,
    ) -> None:
        self._free = np.flatnonzero([name in free for name in UNKNOWNS])
        self._priors = np.append(PRIOR[:-1], observed.curve_dev_per_m)
        self._c, self._m = 7 if zooms else 6, len(self._free)
        order = np.argsort(observed.landmarks, kind="stable")
        self.k, self.l = keyframes, landmarks
        self.keyframes, self.landmarks = observed.keyframes[order], observed.landmarks[order]
        self.pixels, self.pixels_px = observed.pixels[order], observed.pixels_px[order]
        self.has_depth = np.isfinite(observed.depths_m[order])
        self.depths_m = np.where(self.has_depth, observed.depths_m[order], 0.0)
        self.depths_dev_m = np.where(self.has_depth, observed.depths_dev_m[order], 1.0)
        self.rates_m_s = np.where(self.has_depth, observed.rates_m_s[order], 0.0)
        self.camera = observed.camera
        twists = observed.twists_s[self.keyframes]
        self.rates, self.turns = twists[:, :3], twists[:, 3:]
        self.moments = self.pixels[:, 1:] / self.camera.height - 0.5
        self.pixel_factor = self.depth_factor = 1.0
        self._of_keyframe = [np.flatnonzero(self.keyframes == row) for row in range(keyframes)]
        size = self._c * keyframes + self._m
        # What no keyframe sees of a landmark stays 0 in E from one step to the next.
        self._equations = NormalEquations(
            np.zeros((size, size)), np.zeros(size), np.zeros((landmarks, 3, size)),
            np.zeros((landmarks, 3, 3)), np.zeros((landmarks, 3)),
        )  # fmt: skip
        columns = self._c * self.keyframes[:, None, None] + np.arange(self._c)
        self._seen_at = self.landmarks[:, None, None], np.arange(3)[:, None], columns

    def residuals(self, state: _State) -> tuple[Array, Array]:
        """Return ``(n, 3)`` residuals of pixel and depth in their units, and points in the camera."""
        T = state.T[self.keyframes]
        seen = np.einsum("nij,nj->ni", T[:, :3, :3], state.points[self.landmarks]) + T[:, :3, 3]
        z = np.maximum(seen[:, 2], _NEAR_M)
        a, b, cx, cy, k1, offset, delay, readout, curve = state.values
        x, y = seen[:, 0] / z, seen[:, 1] / z
        bent = 1.0 + k1 * (x * x + y * y)
        zoom = np.exp(state.zooms[self.keyframes])
        residual = np.empty((len(z), 3))
        residual[:, 0] = (
            self.camera.fx * np.exp(a) * zoom * x * bent + self.camera.cx + cx - self.pixels[:, 0]
        )
        residual[:, 1] = (
            self.camera.fy * np.exp(b) * zoom * y * bent + self.camera.cy + cy - self.pixels[:, 1]
        )
        if readout:
            later = seen + readout * self.moments * (self.rates + np.cross(self.turns, seen))
            later_z = np.maximum(later[:, 2], _NEAR_M)
            residual[:, 0] += self.camera.fx * (later[:, 0] / later_z - x)
            residual[:, 1] += self.camera.fy * (later[:, 1] / later_z - y)
        residual[:, 2] = np.where(
            self.has_depth,
            seen[:, 2] + offset + curve * seen[:, 2] ** 2 - self.rates_m_s * delay - self.depths_m,
            0.0,
        )
        return residual, seen

    def _scales(self) -> Array:
        return np.stack(
            [
                1.0 / (self.pixel_factor * self.pixels_px), 1.0 / (self.pixel_factor * self.pixels_px),
                np.where(self.has_depth, 1.0 / (self.depth_factor * self.depths_dev_m), 0.0),
            ],
            axis=1,
        )  # fmt: skip

    def rescale(self, state: _State) -> None:
        """Take the deviations of pixels and depths from their residuals."""
        residual, _ = self.residuals(state)
        pixels = np.abs(residual[:, :2] / self.pixels_px[:, None])
        self.pixel_factor = max(0.05, _MAD * float(np.median(pixels)))
        if self.has_depth.sum() > 20:
            depths = np.abs(residual[:, 2] / self.depths_dev_m)[self.has_depth]
            self.depth_factor = max(0.1, _MAD * float(np.median(depths)))

    def cost(self, state: _State) -> float:
        residual, seen = self.residuals(state)
        whitened = np.square(residual * self._scales())
        squares = np.stack([whitened[:, :2].sum(axis=1), whitened[:, 2]])
        each = _CAUCHY**2 * np.log1p(squares / _CAUCHY**2)
        each[0] = np.where(seen[:, 2] > _NEAR_M, each[0], _BEHIND)
        priors = ((state.values / self._priors) ** 2).sum() + ((state.zooms / _ZOOM_PRIOR) ** 2).sum()
        return float(each.sum() + priors)

    def linearise(self, state: _State) -> None:
        """Take weighted Jacobians and residuals."""
        residual, seen = self.residuals(state)
        z = np.maximum(seen[:, 2], _NEAR_M)
        n = len(z)
        a, b, _, _, k1 = state.values[:5]
        x, y = seen[:, 0] / z, seen[:, 1] / z
        r2 = x * x + y * y
        bent = 1.0 + k1 * r2
        zoom = np.exp(state.zooms[self.keyframes])
        fx, fy = self.camera.fx * np.exp(a) * zoom, self.camera.fy * np.exp(b) * zoom
        J_xy = np.empty((n, 2, 2))
        J_xy[:, 0, 0], J_xy[:, 0, 1] = fx * (bent + 2 * k1 * x * x), fx * 2 * k1 * x * y
        J_xy[:, 1, 0], J_xy[:, 1, 1] = fy * 2 * k1 * x * y, fy * (bent + 2 * k1 * y * y)
        J_seen = np.zeros((n, 3, 3))
        J_seen[:, :2, :2] = J_xy / z[:, None, None]
        J_seen[:, :2, 2] = -(J_xy @ np.stack([x, y], axis=1)[:, :, None])[:, :, 0] / z[:, None]
        J_seen[:, 2, 2] = 1.0 + 2.0 * state.values[8] * seen[:, 2]
        J_c = np.zeros((n, 3, 7))
        J_c[:, :, :3] = J_seen
        J_c[:, :, 3:6] = -J_seen @ skew(seen)
        J_v = np.zeros((n, 3, len(UNKNOWNS)))
        J_v[:, 0, 0], J_v[:, 1, 1] = fx * x * bent, fy * y * bent
        J_c[:, 0, 6], J_c[:, 1, 6] = J_v[:, 0, 0], J_v[:, 1, 1]
        J_v[:, 0, 2] = J_v[:, 1, 3] = 1.0
        J_v[:, 0, 4], J_v[:, 1, 4] = fx * x * r2, fy * y * r2
        moving = self.moments * (self.rates + np.cross(self.turns, seen))
        J_v[:, :2, 7] = (J_seen[:, :2] @ moving[:, :, None])[:, :, 0]
        J_v[:, 2, 5], J_v[:, 2, 6], J_v[:, 2, 8] = 1.0, -self.rates_m_s, seen[:, 2] ** 2
        scales = self._scales()
        whitened = residual * scales
        pixel = 1.0 / (1.0 + (whitened[:, :2] ** 2).sum(axis=1) / _CAUCHY**2)
        depth = 1.0 / (1.0 + whitened[:, 2] ** 2 / _CAUCHY**2)
        in_front = seen[:, 2] > _NEAR_M
        weights = np.sqrt(np.stack([pixel, pixel, depth], axis=1) * in_front[:, None])
        rows = (weights * scales)[:, :, None]
        J_p = (J_seen @ state.T[self.keyframes, :3, :3]) * rows
        self._J = J_c[:, :, : self._c] * rows, J_v[:, :, self._free] * rows, J_p
        self._r = whitened * weights
        self._normal()

    def _normal(self) -> None:
        J_c, J_v, J_p = self._J
        c, m, split = self._c, self._m, self._c * self.k
        equations = self._equations
        H, g, E = equations.H, equations.g, equations.E
        H[:], g[:] = 0.0, 0.0
        for row, own in enumerate(self._of_keyframe):
            at = slice(c * row, c * row + c)
            stacked, others = J_c[own].reshape(-1, c), J_v[own].reshape(-1, m)
            r = self._r[own].ravel()
            H[at, at] = stacked.T @ stacked
            H[at, split:] = stacked.T @ others
            H[split:, at] = H[at, split:].T
            H[split:, split:] += others.T @ others
            g[at] = stacked.T @ r
            g[split:] += others.T @ r
        J_pt = J_p.transpose(0, 2, 1)
        E[self._seen_at] = J_pt @ J_c
        E[:, :, split:] = _summed(J_pt @ J_v, self.landmarks, self.l)
        equations.H_landmarks = _summed(J_pt @ J_p, self.landmarks, self.l)
        equations.g_landmarks = _summed((J_pt @ self._r[:, :, None])[:, :, 0], self.landmarks, self.l)

    def _reduced(self, damping: float) -> ReducedEquations:
        """Return the equations of poses and calibration, with priors."""
        reduced = self._equations.reduce(damping, self._prior(), _POINT_INFORMATION)
        if self._c == 7:
            # The mean of the zooms is the common focal length's.
            zoom = 7 * np.arange(self.k) + 6
            reduced.S[np.ix_(zoom, zoom)] += _MEAN_INFORMATION / self.k
        return reduced

    def _prior(self) -> Array:
        own = np.full((self.k, self._c), _POSE_INFORMATION)
        own[:, 6:] = 1.0 / _ZOOM_PRIOR**2
        return np.concatenate([own.ravel(), 1.0 / self._priors[self._free] ** 2])

    def step(self, state: _State, damping: float) -> _State:
        """Return the state after one damped step."""
        reduced = self._reduced(damping)
        k, c = self.k, self._c
        now = np.zeros((k, c))
        now[:, 6:] = state.zooms[:, None]
        pull = self._prior() * np.concatenate([now.ravel(), state.values[self._free]])
        d = np.linalg.solve(reduced.S, reduced.right - pull)
        own = d[: c * k].reshape(k, c)
        limit = min(1.0, _MOST_TURN_RAD / max(float(np.abs(own[:, 3:6]).max()), 1e-12))
        values = state.values.copy()
        values[self._free] += limit * d[c * k :]
        return _State(
            exp_se3(limit * own[:, :6]) @ state.T,
            state.points + limit * self._equations.landmark_steps(reduced, d),
            values,
            state.zooms + limit * own[:, 6] if c == 7 else state.zooms,
        )

    def result(self, state: _State) -> Calibrated:
        """Return the state with its deviations."""
        reduced = self._reduced(0.0)
        S, P = reduced.S, reduced.landmark_covariance
        k, c, m, split = self.k, self._c, self._m, self._c * self.k
        whole: Array = np.linalg.inv(S).astype(np.float64, copy=False)
        rows = np.arange(split, split + m)
        if c == 7:
            rows = np.concatenate([rows, 7 * np.arange(k) + 6])
        own = whole[rows][:, rows]
        growth = np.sqrt(self._inflation(whole[rows], P, np.diag(own)))
        own = own * growth[:, None] * growth[None]
        covariance: Array = np.zeros((len(UNKNOWNS), len(UNKNOWNS)))
        zooms_covariance: Array = np.zeros((k, k))
        covariance[np.ix_(self._free, self._free)] = own[:m, :m]
        if c == 7:
            zooms_covariance = own[m:, m:]
        # Held one too large, an unknown moves the poses by this.
        pulled = -np.linalg.solve(S[:split, :split], S[:split, split:]).reshape(k, c, m)
        # The centre -R^T t moves by -R^T rho with a twist (rho, phi) on the left.
        slopes = -state.T[:, :3, :3].transpose(0, 2, 1)
        bends = np.zeros((len(UNKNOWNS), k, 3))
        bends[self._free] = np.einsum("kij,kjv->vki", slopes, pulled[:, :3])
        return Calibrated(
            values=state.values, covariance=covariance, zooms=state.zooms, zooms_covariance=zooms_covariance,
            T_camera_world=state.T, points_world=state.points, bends_m=bends,
            noise_m=self._noise(state, whole[:split, :split], slopes), cost=self.cost(state),
            has_metres=self._has_metres(), pixel_factor=self.pixel_factor, depth_factor=self.depth_factor,
        )  # fmt: skip

    def _inflation(self, rows: Array, P: Array, variances: Array) -> Array:
        """Return by how much variances grow where errors of one stretch of the drive go together."""
        k, split = self.k, self._c * self.k
        of_points = np.einsum("lar,lab->rlb", self._equations.E @ rows.T, P)
        of_cameras = rows[:, :split].reshape(len(rows), k, self._c)
        pull_c, pull_v, pull_p = ((J.transpose(0, 2, 1) @ self._r[:, :, None])[:, :, 0] for J in self._J)
        moved = pull_v @ rows[:, split:].T
        for column in range(len(rows)):
            moved[:, column] += (of_cameras[column, self.keyframes] * pull_c).sum(axis=1)
            moved[:, column] -= (of_points[column, self.landmarks] * pull_p).sum(axis=1)
        across, down = self.camera.width / _CELLS, self.camera.height / _CELLS
        cells = (np.clip(self.pixels // (across, down), 0, _CELLS - 1) @ (1, _CELLS)).astype(np.int64)
        grown = np.ones(len(rows))
        for clusters, count in (
            (self.landmarks, self.l), (self.keyframes * min(_BLOCKS, k) // k, min(_BLOCKS, k)),
            (cells, _CELLS**2),
        ):  # fmt: skip
            squares = (_summed(moved, clusters, count) ** 2).sum(axis=0) * count / max(1, count - 1)
            grown += np.maximum(squares / np.maximum(variances, 1e-30) - 1.0, 0.0)
        return grown

    def _has_metres(self) -> bool:
        return bool(self.has_depth.any())

    def _noise(self, state: _State, covariance: Array, slopes: Array) -> float:
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = root @ np.random.default_rng(3).standard_normal((len(root), _SAMPLES))
        moved = np.einsum("kij,kjs->ski", slopes, drawn.reshape(self.k, self._c, _SAMPLES)[:, :3])
        positions = inverse(state.T)[:, :3, 3]
        metres = self._has_metres()
        squares = [rms_after_alignment(positions, each, has_metres=metres) ** 2 for each in moved]
        return float(np.sqrt(np.mean(squares)))


def rms_after_alignment(positions: Array, moved: Array, *, has_metres: bool) -> float:
    """Return the root mean square of ``(k, 3)`` small motions *moved* of ``(k, 3)`` *positions*, metres.

    The best small motion of all of them is taken away before, and a scale where there are no metres.
    """
    at = positions - positions.mean(axis=0)
    J = np.concatenate([np.tile(np.eye(3), (len(at), 1, 1)), -skew(at)], axis=2).reshape(-1, 6)
    if not has_metres:
        J = np.column_stack([J, at.ravel()])
    flat = moved.reshape(-1)
    left = flat - J @ np.linalg.lstsq(J, flat, rcond=None)[0]
    return float(np.sqrt((left**2).sum() / len(at)))


def _summed(values: Array, rows: Rows, count: int) -> Array:
    """Return sums of ``(n, ...)`` values over equal rows, ``(count, ...)``."""
    flat = values.reshape(len(values), -1)
    total = np.stack([np.bincount(rows, column, count) for column in flat.T], axis=1)
    summed: Array = total.astype(np.float64, copy=False).reshape(count, *values.shape[1:])
    return summed
