"""Self-calibration: bundle adjustment of a drive together with the errors of its calibration.

Levenberg-Marquardt over poses, landmarks and calibration with Cauchy weights; landmarks are eliminated by the
Schur complement.  Matches are selected, and results are explained to the user, in `client_sdk.check`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, DegenerateGeometry
from rse_pf.geometry import Array, Camera, exp_se3, inverse, skew
from rse_pf.slam.schur import NormalEquations, ReducedEquations
from rse_pf.slam.triangulation import sum_by_index, triangulate_rays

__all__ = [
    "UNKNOWNS",
    "Calibrated",
    "DriveObservations",
    "adjust_with_calibration",
    "estimate_part_deviations",
    "rms_after_alignment",
    "triangulate_landmarks",
]

Rows = npt.NDArray[np.int64]

UNKNOWNS = ("fx", "fy", "cx", "cy", "k1", "offset", "delay", "readout", "curve")
"""Names of the nine errors of a calibration that an adjustment can estimate, in the order of all arrays
``(9,)``:

- ``fx``, ``fy``: natural logarithm of the quotient of true and stated focal length
- ``cx``, ``cy``: true minus stated principal point, px
- ``k1``: first coefficient of a radial distortion that remains after undistortion
- ``offset``: metres by which a measured depth is too large, at any depth
- ``delay``: seconds by which depth images lag: they show the scene that many seconds earlier than the colour
  images with the same time stamps
- ``readout``: seconds from the exposure of the first to that of the last row of a rolling shutter
- ``curve``: factor c (1/m) of a depth error that grows with the depth: the measured depth of a point at the
  depth z is ``c z^2`` metres too large
"""
PRIOR = np.array([0.15, 0.15, 40.0, 40.0, 0.15, 0.15, 0.3, 0.02, 0.01])
"""Prior standard deviations of `UNKNOWNS`, in their units: typical errors of calibrations.  For ``curve``,
the last one, an adjustment takes `DriveObservations.curve_dev_per_m` instead."""
# Prior standard deviation of a zoom: the natural logarithm of the quotient of the focal length of one
# keyframe and the common one.
_ZOOM_PRIOR = 0.15
_CAUCHY_SCALE = 2.0  # residual, in its standard deviations, to which the Cauchy loss gives half the weight
_ITERATIONS = 12  # largest number of steps of an adjustment in which all keyframes share one focal length
_ZOOM_ITERATIONS = 6
"""Largest number of steps of an adjustment with a focal length for each keyframe, which begins near its
solution."""
_RESCALE_ITERATIONS = (1, 4)
"""Indices, from 0, of the steps after which the noise is estimated again from the residuals."""
_MIN_CONVERGED_ITERATION = 4
"""Index, from 0, of the last step after which an adjustment goes on even if it has converged: after this step
the noise is estimated again for the last time."""
_CONVERGED_SHARE = 1e-4  # an adjustment ends when a step lowers the cost by less than this share
_FIRST_DAMPING = 1e-4  # Levenberg-Marquardt's share of the diagonal: nearly Gauss-Newton at first
_MIN_DAMPING = 1e-9  # Levenberg-Marquardt's share of the diagonal is not lowered below this
_MAX_DAMPING = 1e4  # an adjustment ends when no step with damping up to this share lowers the cost
# Depth in metres at which a landmark is projected that is nearer than this depth, or behind the camera.
_MIN_DEPTH_M = 0.02
_BEHIND_COST = 1e3
"""Cost, far above that of an outlier, of a pixel whose landmark is behind the camera or nearer than
`_MIN_DEPTH_M`."""
_TIME_BLOCKS = 6  # number of consecutive parts of a drive; errors within a part count as correlated
_IMAGE_CELLS = 6
"""Number of columns, and of rows, of regions into which images are divided; errors within a region count as
correlated."""
_MAD_TO_SIGMA = 1.4826  # quotient of standard deviation and median absolute deviation of normal noise
# Smallest ratio of the noise of pixels, estimated from residuals, to their stated deviations; it replaces a
# smaller one.
_MIN_PIXEL_FACTOR = 0.05
# Smallest ratio of the noise of depths, estimated from residuals, to their stated deviations; it replaces a
# smaller one.
_MIN_DEPTH_FACTOR = 0.1
# Number of depths of a drive above which their noise is estimated from residuals; up to it, the noise is that
# of their stated deviations.
_MIN_DEPTHS = 20
_MAX_PARTS = 4  # largest number of parts of a drive that are adjusted alone to see whether they agree
_MIN_PART_KEYFRAMES = 6
"""Smallest number of keyframes of a part of a drive that is adjusted alone: fewer do not determine the
calibration."""
_MAX_STEP_RAD = 0.5
"""Largest rotation, in radians, of a keyframe about an axis in one step, since the linearisation does not
hold beyond it: the whole step is shortened."""
_ZOOM_MEAN_INFORMATION = 1e8
"""Information, for each keyframe, on the mean of all zooms.  A zoom is the natural logarithm of the quotient
of the focal length of a keyframe and the common one.  The information holds the mean at 0, since ``fx`` and
``fy`` already describe the common focal length."""
_NOISE_SAMPLES = 8  # random perturbations of a drive from which the uncertainty of its path is computed
_POSE_INFORMATION = 1.0
"""Information (1/m^2, 1/rad^2) of a prior that is added for each component of a keyframe's twist.  It is far
below the information from the observations of a drive, and fixes what these leave open (the gauge): position
and orientation of the world, and without depths its scale."""
# Information of a prior (1/m^2) that is added for each coordinate of a landmark, far below that from one
# pixel.
_POINT_INFORMATION = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveObservations:
    """What the *k* keyframes of a drive observe of *l* landmarks: *n* pixels, some of them with a depth.

    Attributes:
        camera: The stated intrinsics of the drive, whose errors are estimated.
        keyframes: ``(n,)``, index of the keyframe of each observation.
        landmarks: ``(n,)``, index of its landmark; a keyframe observes a landmark at most once.
        pixels: ``(n, 2)``, undistorted pixels.
        pixel_deviations_px: ``(n,)``, standard deviations of the pixels, px.
        depths_m: ``(n,)``, depths along the optical axis; NaN without a depth.
        depth_deviations_m: ``(n,)``, standard deviations of the depths; not read without a depth.
        rates_m_s: ``(n,)``, change of the depth at the pixel with time, m/s; 0 where it is not known.
        twists_s: ``(k, 6)``, velocity of the camera at each keyframe: translation (m/s) and rotation (rad/s)
            of the twist by which ``T_camera_world`` is multiplied on the left in one second; 0 where it is
            not known.
        curve_dev_per_m: Prior standard deviation of the unknown ``curve``.

    Raises:
        BadRequest: The arrays of observations have different lengths.
    """

    camera: Camera
    keyframes: Rows
    landmarks: Rows
    pixels: Array
    pixel_deviations_px: Array
    depths_m: Array
    depth_deviations_m: Array
    rates_m_s: Array
    twists_s: Array
    curve_dev_per_m: float = float(PRIOR[-1])

    def __post_init__(self) -> None:
        n = len(self.keyframes)
        columns = (
            self.landmarks,
            self.pixel_deviations_px,
            self.depths_m,
            self.depth_deviations_m,
            self.rates_m_s,
        )
        if any(column.shape != (n,) for column in columns) or self.pixels.shape != (n, 2):
            raise BadRequest(
                f"the arrays of {n} observations have the shapes "
                f"{[self.pixels.shape, *(column.shape for column in columns)]}",
                hint="give one row for each observation",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibrated:
    """A drive of *k* keyframes and *l* landmarks after `adjust_with_calibration`.

    Attributes:
        values: ``(9,)``, errors of the calibration, see `UNKNOWNS`; those that were not estimated keep the
            value with which the adjustment began.
        covariance: ``(9, 9)`` of the values, inflated where residuals are correlated.
        zooms: ``(k,)``, natural logarithm of the quotient of the focal length of each keyframe and the common
            one.
        zooms_covariance: ``(k, k)`` of the zooms; 0 if they were not estimated.
        T_camera_world: ``(k, 4, 4)``, adjusted poses, metres.
        points_world: ``(l, 3)``, adjusted landmarks, metres.
        bends_m: ``(9, k, 3)``, for each error of the calibration the derivative of the keyframes' positions
            in the world by this error: the displacements that result if the error is fixed one unit above its
            estimate and the poses are adjusted again.  0 for errors that were not estimated.
        noise_m: Uncertainty of the path: root mean square of the random errors of the keyframes' positions
            after alignment, including the errors that result from the uncertainty of the estimated
            calibration.
        has_metric_scale: Whether depths determine the metric scale; else paths are compared up to scale.
        depth_factor: Noise of the depths over their stated standard deviations.
    """

    values: Array
    covariance: Array
    zooms: Array
    zooms_covariance: Array
    T_camera_world: Array
    points_world: Array
    bends_m: Array
    noise_m: float
    has_metric_scale: bool
    depth_factor: float

    @property
    def deviations(self) -> Array:
        """The standard deviations ``(9,)`` of the values, in the units of `UNKNOWNS`."""
        return np.sqrt(np.diag(self.covariance))

    def bend_m(self, error: Array) -> float:
        """Return how far a calibration that is wrong by *error* ``(9,)`` bends the path, m.

        That is the root mean square change of the keyframes' positions after alignment of both paths.
        """
        moved = np.tensordot(error, self.bends_m, axes=1)
        return rms_after_alignment(
            inverse(self.T_camera_world)[:, :3, 3], moved, has_metric_scale=self.has_metric_scale
        )


def triangulate_landmarks(observed: DriveObservations, T_camera_world: Array, count: int) -> Array:
    """Return the positions of *count* landmarks ``(count, 3)``, m, by linear least squares.

    Each observation pulls its landmark to its ray with weight 1, and to the point at its depth, if it has
    one, with the inverse variance of this depth.  A landmark with one ray and no depth gets the point of the
    ray that is nearest to the origin of the world, and a landmark without observations gets the origin.

    Args:
        observed: Observations of the landmarks.
        T_camera_world: ``(k, 4, 4)``, poses of the keyframes.
        count: Number of landmarks.
    """
    camera, T = observed.camera, T_camera_world[observed.keyframes]
    rays = camera.back_project(observed.pixels, np.ones(len(T)))
    rotated = np.einsum("nji,nj->ni", T[:, :3, :3], rays)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    has_depth = np.isfinite(observed.depths_m)
    variances = np.where(
        has_depth, np.square(observed.depth_deviations_m, where=has_depth, out=np.ones(len(T))), 1.0
    )
    points_at_depth = centres + np.nan_to_num(observed.depths_m)[:, None] * rotated
    depth_weights: Array = np.where(has_depth, 1.0 / variances, 0.0)
    return triangulate_rays(
        centres, rotated, np.ones(len(T)), points_at_depth, depth_weights, observed.landmarks, count
    )


def adjust_with_calibration(
    observed: DriveObservations,
    T_camera_world: Array,
    points_world: Array,
    free: tuple[str, ...],
    *,
    zooms: bool = False,
    values: Array | None = None,
) -> Calibrated:
    """Adjust poses, landmarks and calibration until they agree best with the observed pixels and depths.

    The result has new arrays; the arguments are not changed.

    The model of a pixel is ``f e^(fx + zoom) x (1 + k1 r^2) + c + cx`` for the point ``(x, y, 1)`` of the
    camera frame with ``r^2 = x^2 + y^2``, moved by the rolling shutter.  The model of a measured depth is ``z
    + offset + curve z^2 - rate * delay``.

    Args:
        observed: The observations of all keyframes.
        T_camera_world: ``(k, 4, 4)``, poses with which the adjustment begins.
        points_world: ``(l, 3)``, landmarks with which the adjustment begins, see `triangulate_landmarks`.
        free: The `UNKNOWNS` that are estimated; the others keep their values.
        zooms: Whether a focal length is estimated for each keyframe.
        values: ``(9,)``, errors of the calibration with which the adjustment begins; None for 0.  The priors
            pull the estimated ones to 0, not to these values.

    Raises:
        BadRequest: *free* names an unknown that does not exist.
        DegenerateGeometry: The linear system has no solution.

    Source:
        Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6; covariances by the sandwich
        estimator of White, Econometrica 1980, over clusters of residuals.
    """
    unknown_names = set(free) - set(UNKNOWNS)
    if unknown_names:
        raise BadRequest(f"no unknown named {sorted(unknown_names)}", hint=f"choose of {', '.join(UNKNOWNS)}")
    system = _DriveSystem(observed, len(T_camera_world), len(points_world), free, zooms=zooms)
    first_values = np.zeros(len(UNKNOWNS)) if values is None else values
    state = _State(
        T_camera_world.copy(), points_world.copy(), first_values.copy(), np.zeros(len(T_camera_world))
    )

    damping = _FIRST_DAMPING
    system.estimate_noise(state)
    cost = system.cost(state)
    try:
        for iteration in range(_ZOOM_ITERATIONS if zooms else _ITERATIONS):
            # 1. Linearise, and try steps with growing damping until one lowers the cost; end if none does.
            system.linearise(state)
            next_state, next_cost = state, np.inf
            while damping <= _MAX_DAMPING:
                next_state = system.step(state, damping)
                next_cost = system.cost(next_state)
                if next_cost < cost:
                    break
                damping *= 10.0
            if not next_cost < cost:
                break
            is_converged = cost - next_cost < _CONVERGED_SHARE * cost
            state, cost, damping = next_state, next_cost, max(damping * 0.1, _MIN_DAMPING)
            # 2. After some steps, estimate the noise again from the residuals, which corrects the weights of
            #    outliers; after other steps, end if the adjustment has converged.
            if iteration in _RESCALE_ITERATIONS:
                system.estimate_noise(state)
                cost = system.cost(state)
            elif is_converged and iteration > _MIN_CONVERGED_ITERATION:
                break
        # 3. Estimate the noise at the solution, and compute the covariances with it.
        system.estimate_noise(state)
        system.linearise(state)
        return system.result(state)
    except np.linalg.LinAlgError as error:
        raise DegenerateGeometry(
            "the keyframes of this drive do not determine their poses",
            hint="move more, and past more texture",
        ) from error


def estimate_part_deviations(
    observed: DriveObservations, adjusted: Calibrated, free: tuple[str, ...]
) -> Array:
    """Return how far parts of a drive disagree about the calibration, as standard deviations ``(9,)``.

    The calibration of each part is estimated alone.  The result is the standard deviation of the mean of
    these estimates, in the units of `UNKNOWNS`, that results from the variance between the parts which their
    covariances do not explain, see `disagreement`.  It is above 0 where the model lacks an effect, such as
    errors of depth that change with the scene.  It is 0 if fewer than two parts of the drive have enough
    keyframes and can be adjusted, and for unknowns that are not in *free*.

    Args:
        observed: The observations of the whole drive.
        adjusted: The result of `adjust_with_calibration` for the whole drive.
        free: The `UNKNOWNS` that were estimated.
    """
    keyframe_count = len(adjusted.T_camera_world)
    part_count = min(_MAX_PARTS, keyframe_count // _MIN_PART_KEYFRAMES)
    values, variances = [], []
    for part in range(part_count if part_count > 1 else 0):
        keyframes = np.arange(keyframe_count * part // part_count, keyframe_count * (part + 1) // part_count)
        try:
            adjusted_part = adjust_with_calibration(
                *_select_keyframes(observed, adjusted, keyframes), free, values=adjusted.values
            )
        except DegenerateGeometry:
            continue
        values.append(adjusted_part.values)
        variances.append(np.diag(adjusted_part.covariance))
    deviations: Array = np.zeros(len(UNKNOWNS))
    if len(values) < 2:
        return deviations
    indices = [UNKNOWNS.index(name) for name in free]
    deviations[indices] = disagreement(np.array(values)[:, indices], np.array(variances)[:, indices])
    return deviations


def disagreement(values: Array, variances: Array) -> Array:
    """Return the standard deviations ``(n,)`` of means that the variances of the averaged estimates leave
    out.

    *values* and *variances* are ``(p, n)``: estimates of *n* quantities in *p* groups, with p at least 2, and
    their variances.  If the estimates of a quantity differ more than their variances explain, there is a
    variance between the groups; the result is the square root of this variance divided by *p*.  Otherwise it
    is 0.

    Source:
        DerSimonian and Laird, Controlled Clinical Trials 1986, Sect. 2: the variance between studies.
    """
    w = 1.0 / np.maximum(variances, 1e-18)
    mean = (w * values).sum(axis=0) / w.sum(axis=0)
    excess = (w * (values - mean) ** 2).sum(axis=0) - (len(values) - 1)
    between = np.maximum(excess, 0.0) / (w.sum(axis=0) - (w**2).sum(axis=0) / w.sum(axis=0))
    deviations: Array = np.sqrt(between / len(values))
    return deviations


def _select_keyframes(
    observed: DriveObservations, adjusted: Calibrated, keyframes: Rows
) -> tuple[DriveObservations, Array, Array]:
    """Return the observations, poses and landmarks of *keyframes* alone, numbered anew.

    All poses are returned, but only the landmarks that at least two of *keyframes* observe.
    """
    new_index = np.full(len(adjusted.T_camera_world), -1)
    new_index[keyframes] = np.arange(len(keyframes))
    is_selected = new_index[observed.keyframes] >= 0
    observation_counts = np.bincount(observed.landmarks[is_selected], minlength=len(adjusted.points_world))
    is_selected &= observation_counts[observed.landmarks] > 1
    selected_landmarks, landmarks = np.unique(observed.landmarks[is_selected], return_inverse=True)
    selected = replace(
        observed,
        keyframes=new_index[observed.keyframes[is_selected]],
        landmarks=landmarks,
        pixels=observed.pixels[is_selected],
        pixel_deviations_px=observed.pixel_deviations_px[is_selected],
        depths_m=observed.depths_m[is_selected],
        depth_deviations_m=observed.depth_deviations_m[is_selected],
        rates_m_s=observed.rates_m_s[is_selected],
        twists_s=observed.twists_s[keyframes],
    )
    return selected, adjusted.T_camera_world[keyframes], adjusted.points_world[selected_landmarks]


@dataclass(frozen=True, slots=True)
class _State:
    """The estimates of an adjustment.

    They are poses ``(k, 4, 4)``, landmarks ``(l, 3)``, errors of the calibration ``(9,)``, and zooms
    ``(k,)``.
    """

    T_camera_world: Array
    points: Array
    values: Array
    zooms: Array


class _DriveSystem:
    """The normal equations of a drive, with observations in the order of their landmarks.

    The parameters of the equations are those of all keyframes, one after the other (a twist on the left of
    ``T_camera_world``, and a zoom if zooms are estimated), and then the free unknowns of the calibration.
    """

    def __init__(
        self,
        observed: DriveObservations,
        keyframe_count: int,
        landmark_count: int,
        free: tuple[str, ...],
        *,
        zooms: bool,
    ) -> None:
        self._free = np.flatnonzero([name in free for name in UNKNOWNS])
        self._priors = np.append(PRIOR[:-1], observed.curve_dev_per_m)
        self._keyframe_count, self._landmark_count = keyframe_count, landmark_count
        self._keyframe_size = 7 if zooms else 6
        self._poses_size = self._keyframe_size * keyframe_count
        # 1. Sort the observations by landmark.
        order = np.argsort(observed.landmarks, kind="stable")
        self.camera = observed.camera
        self.keyframes, self.landmarks = observed.keyframes[order], observed.landmarks[order]
        self.pixels, self.pixel_deviations_px = observed.pixels[order], observed.pixel_deviations_px[order]
        self.has_depth = np.isfinite(observed.depths_m[order])
        self.has_metric_scale = bool(self.has_depth.any())
        self.depths_m = np.where(self.has_depth, observed.depths_m[order], 0.0)
        self.depth_deviations_m = np.where(self.has_depth, observed.depth_deviations_m[order], 1.0)
        self.rates_m_s = np.where(self.has_depth, observed.rates_m_s[order], 0.0)
        # 2. Take the velocity of the camera at each observation, and the time at which its row is exposed, as
        # a share of the readout: -0.5 for the first row of the image, 0.5 for the last.
        twists = observed.twists_s[self.keyframes]
        self._velocities, self._angular_rates = twists[:, :3], twists[:, 3:]
        self._row_fractions = self.pixels[:, 1:] / self.camera.height - 0.5
        # 3. Begin with the stated deviations, and allocate the normal equations.
        self.pixel_factor = self.depth_factor = 1.0
        self._observations_of_keyframe = [np.flatnonzero(self.keyframes == k) for k in range(keyframe_count)]
        size = self._poses_size + len(self._free)
        # Entries of E for keyframes that do not observe a landmark are 0 and are never written.
        self._equations = NormalEquations(
            np.zeros((size, size)),
            np.zeros(size),
            np.zeros((landmark_count, 3, size)),
            np.zeros((landmark_count, 3, 3)),
            np.zeros((landmark_count, 3)),
        )
        columns = self._keyframe_size * self.keyframes[:, None, None] + np.arange(self._keyframe_size)
        self._E_indices = self.landmarks[:, None, None], np.arange(3)[:, None], columns

    def residuals(self, state: _State) -> tuple[Array, Array]:
        """Return the residuals ``(n, 3)``, and the landmarks ``(n, 3)``, m, in the frames of their cameras.

        A residual is model minus observation: of column and row, px, and of the depth, m (0 without one).
        The landmarks are those at the moment of the middle row, without the motion of a rolling shutter.
        """
        T = state.T_camera_world[self.keyframes]
        points_camera = np.einsum("nij,nj->ni", T[:, :3, :3], state.points[self.landmarks]) + T[:, :3, 3]
        z = np.maximum(points_camera[:, 2], _MIN_DEPTH_M)
        a, b, cx, cy, k1, offset, delay, readout, curve = state.values
        x, y = points_camera[:, 0] / z, points_camera[:, 1] / z
        radial = 1.0 + k1 * (x * x + y * y)
        zoom = np.exp(state.zooms[self.keyframes])
        residual = np.empty((len(z), 3))
        residual[:, 0] = (
            self.camera.fx * np.exp(a) * zoom * x * radial + self.camera.cx + cx - self.pixels[:, 0]
        )
        residual[:, 1] = (
            self.camera.fy * np.exp(b) * zoom * y * radial + self.camera.cy + cy - self.pixels[:, 1]
        )
        if readout:
            # A row is exposed before or after the middle one, when the camera has moved.
            motion = self._velocities + np.cross(self._angular_rates, points_camera)
            exposed = points_camera + readout * self._row_fractions * motion
            exposed_z = np.maximum(exposed[:, 2], _MIN_DEPTH_M)
            residual[:, 0] += self.camera.fx * (exposed[:, 0] / exposed_z - x)
            residual[:, 1] += self.camera.fy * (exposed[:, 1] / exposed_z - y)
        residual[:, 2] = np.where(
            self.has_depth,
            points_camera[:, 2]
            + offset
            + curve * points_camera[:, 2] ** 2
            - self.rates_m_s * delay
            - self.depths_m,
            0.0,
        )
        return residual, points_camera

    def _inverse_deviations(self) -> Array:
        """Return the inverses ``(n, 3)`` of the standard deviations of pixel and depth; 0 without a depth."""
        pixel = 1.0 / (self.pixel_factor * self.pixel_deviations_px)
        depth = np.where(self.has_depth, 1.0 / (self.depth_factor * self.depth_deviations_m), 0.0)
        return np.stack([pixel, pixel, depth], axis=1)

    def estimate_noise(self, state: _State) -> None:
        """Set `pixel_factor` and `depth_factor` from the medians of the absolute residuals at *state*.

        `depth_factor` stays as it is if the drive has no more than `_MIN_DEPTHS` depths.
        """
        residual, _ = self.residuals(state)
        pixel_ratios = np.abs(residual[:, :2] / self.pixel_deviations_px[:, None])
        self.pixel_factor = max(_MIN_PIXEL_FACTOR, _MAD_TO_SIGMA * float(np.median(pixel_ratios)))
        if self.has_depth.sum() > _MIN_DEPTHS:
            depth_ratios = np.abs(residual[:, 2] / self.depth_deviations_m)[self.has_depth]
            self.depth_factor = max(_MIN_DEPTH_FACTOR, _MAD_TO_SIGMA * float(np.median(depth_ratios)))

    def cost(self, state: _State) -> float:
        """Return the Cauchy loss of all residuals plus the costs of the priors."""
        residual, points_camera = self.residuals(state)
        whitened = np.square(residual * self._inverse_deviations())
        squares = np.stack([whitened[:, :2].sum(axis=1), whitened[:, 2]])
        losses = _CAUCHY_SCALE**2 * np.log1p(squares / _CAUCHY_SCALE**2)
        losses[0] = np.where(points_camera[:, 2] > _MIN_DEPTH_M, losses[0], _BEHIND_COST)
        priors = ((state.values / self._priors) ** 2).sum() + ((state.zooms / _ZOOM_PRIOR) ** 2).sum()
        return float(losses.sum() + priors)

    def linearise(self, state: _State) -> None:
        """Compute the weighted Jacobians and residuals at *state*, and the normal equations from them."""
        # 1. Differentiate pixel and depth by the point in the camera frame.
        residual, points_camera = self.residuals(state)
        z = np.maximum(points_camera[:, 2], _MIN_DEPTH_M)
        n = len(z)
        a, b, _, _, k1 = state.values[:5]
        x, y = points_camera[:, 0] / z, points_camera[:, 1] / z
        r2 = x * x + y * y
        radial = 1.0 + k1 * r2
        zoom = np.exp(state.zooms[self.keyframes])
        fx, fy = self.camera.fx * np.exp(a) * zoom, self.camera.fy * np.exp(b) * zoom
        J_xy = np.empty((n, 2, 2))
        J_xy[:, 0, 0], J_xy[:, 0, 1] = fx * (radial + 2 * k1 * x * x), fx * 2 * k1 * x * y
        J_xy[:, 1, 0], J_xy[:, 1, 1] = fy * 2 * k1 * x * y, fy * (radial + 2 * k1 * y * y)
        J_camera = np.zeros((n, 3, 3))
        J_camera[:, :2, :2] = J_xy / z[:, None, None]
        J_camera[:, :2, 2] = -(J_xy @ np.stack([x, y], axis=1)[:, :, None])[:, :, 0] / z[:, None]
        J_camera[:, 2, 2] = 1.0 + 2.0 * state.values[8] * points_camera[:, 2]
        # 2. Differentiate by pose and zoom of the keyframe, and by the unknowns of the calibration.
        J_keyframe = np.zeros((n, 3, 7))
        J_keyframe[:, :, :3] = J_camera
        J_keyframe[:, :, 3:6] = -J_camera @ skew(points_camera)
        J_values = np.zeros((n, 3, len(UNKNOWNS)))
        J_values[:, 0, 0], J_values[:, 1, 1] = fx * x * radial, fy * y * radial
        J_keyframe[:, 0, 6], J_keyframe[:, 1, 6] = J_values[:, 0, 0], J_values[:, 1, 1]
        J_values[:, 0, 2] = J_values[:, 1, 3] = 1.0
        J_values[:, 0, 4], J_values[:, 1, 4] = fx * x * r2, fy * y * r2
        motion = self._row_fractions * (self._velocities + np.cross(self._angular_rates, points_camera))
        J_values[:, :2, 7] = (J_camera[:, :2] @ motion[:, :, None])[:, :, 0]
        J_values[:, 2, 5], J_values[:, 2, 6] = 1.0, -self.rates_m_s
        J_values[:, 2, 8] = points_camera[:, 2] ** 2
        # 3. Weight residuals by the Cauchy loss; points behind the camera get the weight 0.
        inverse_deviations = self._inverse_deviations()
        whitened = residual * inverse_deviations
        pixel_weights = 1.0 / (1.0 + (whitened[:, :2] ** 2).sum(axis=1) / _CAUCHY_SCALE**2)
        depth_weights = 1.0 / (1.0 + whitened[:, 2] ** 2 / _CAUCHY_SCALE**2)
        is_in_front = points_camera[:, 2] > _MIN_DEPTH_M
        weights = np.stack([pixel_weights, pixel_weights, depth_weights], axis=1) * is_in_front[:, None]
        roots = np.sqrt(weights)
        rows = (roots * inverse_deviations)[:, :, None]
        J_points = (J_camera @ state.T_camera_world[self.keyframes, :3, :3]) * rows
        self._J = (
            J_keyframe[:, :, : self._keyframe_size] * rows,
            J_values[:, :, self._free] * rows,
            J_points,
        )
        self._r = whitened * roots
        # 4. Sum the products of Jacobians and residuals in the normal equations.
        self._set_equations()

    def _set_equations(self) -> None:
        J_keyframe, J_values, J_points = self._J
        size, poses_size, landmark_count = self._keyframe_size, self._poses_size, self._landmark_count
        equations = self._equations
        H, g, E = equations.H, equations.g, equations.E
        H[:], g[:] = 0.0, 0.0
        for keyframe, observations in enumerate(self._observations_of_keyframe):
            block = slice(size * keyframe, size * keyframe + size)
            J_own = J_keyframe[observations].reshape(-1, size)
            J_shared = J_values[observations].reshape(-1, len(self._free))
            r = self._r[observations].ravel()
            H[block, block] = J_own.T @ J_own
            H[block, poses_size:] = J_own.T @ J_shared
            H[poses_size:, block] = H[block, poses_size:].T
            H[poses_size:, poses_size:] += J_shared.T @ J_shared
            g[block] = J_own.T @ r
            g[poses_size:] += J_shared.T @ r
        J_points_T = J_points.transpose(0, 2, 1)
        E[self._E_indices] = J_points_T @ J_keyframe
        E[:, :, poses_size:] = sum_by_index(J_points_T @ J_values, self.landmarks, landmark_count)
        equations.H_landmarks = sum_by_index(J_points_T @ J_points, self.landmarks, landmark_count)
        equations.g_landmarks = sum_by_index(
            (J_points_T @ self._r[:, :, None])[:, :, 0], self.landmarks, landmark_count
        )

    def _reduce(self, damping: float) -> ReducedEquations:
        """Return the equations of keyframes and calibration without landmarks.

        Their matrix ``S`` contains the information of all priors.  Their right side does not contain the
        gradients of the priors, which pull zooms and values to 0; `step` adds them.
        """
        reduced = self._equations.reduce(damping, self._prior_information(), _POINT_INFORMATION)
        if self._keyframe_size == 7:
            zoom_columns = 7 * np.arange(self._keyframe_count) + 6
            reduced.S[np.ix_(zoom_columns, zoom_columns)] += _ZOOM_MEAN_INFORMATION / self._keyframe_count
        return reduced

    def _prior_information(self) -> Array:
        """Return the information ``(m,)`` of the priors of the *m* parameters: the diagonal of a matrix."""
        of_keyframes = np.full((self._keyframe_count, self._keyframe_size), _POSE_INFORMATION)
        of_keyframes[:, 6:] = 1.0 / _ZOOM_PRIOR**2
        return np.concatenate([of_keyframes.ravel(), 1.0 / self._priors[self._free] ** 2])

    def step(self, state: _State, damping: float) -> _State:
        """Return the state after a Levenberg-Marquardt step from *state*, for which `linearise` was called.

        The whole step is shortened if it would rotate a keyframe by more than `_MAX_STEP_RAD` about an axis.
        """
        # 1. Solve for keyframes and calibration; priors pull zooms and values to 0.
        reduced = self._reduce(damping)
        keyframe_values = np.zeros((self._keyframe_count, self._keyframe_size))
        keyframe_values[:, 6:] = state.zooms[:, None]
        parameters = np.concatenate([keyframe_values.ravel(), state.values[self._free]])
        d = np.linalg.solve(reduced.S, reduced.right - self._prior_information() * parameters)
        # 2. Shorten the whole step if a keyframe would rotate too far.
        of_keyframes = d[: self._poses_size].reshape(self._keyframe_count, self._keyframe_size)
        factor = min(1.0, _MAX_STEP_RAD / max(float(np.abs(of_keyframes[:, 3:6]).max()), 1e-12))
        # 3. Apply the step to keyframes, landmarks, values and zooms.
        values = state.values.copy()
        values[self._free] += factor * d[self._poses_size :]
        return _State(
            exp_se3(factor * of_keyframes[:, :6]) @ state.T_camera_world,
            state.points + factor * self._equations.landmark_steps(reduced, d),
            values,
            state.zooms + factor * of_keyframes[:, 6] if self._keyframe_size == 7 else state.zooms,
        )

    def result(self, state: _State) -> Calibrated:
        """Return the solution *state* with its covariances; `linearise` must have been called with it."""
        # 1. Compute the covariance of calibration and zooms, inflated for correlated residuals.
        reduced = self._reduce(0.0)
        S, landmark_covariance = reduced.S, reduced.landmark_covariance
        count, size, poses_size = self._keyframe_count, self._keyframe_size, self._poses_size
        free_count = len(self._free)
        inverse_S: Array = np.linalg.inv(S).astype(np.float64, copy=False)
        parameters = np.arange(poses_size, poses_size + free_count)
        if size == 7:
            parameters = np.concatenate([parameters, 7 * np.arange(count) + 6])
        estimated = inverse_S[parameters][:, parameters]
        inflation = self._variance_inflation(inverse_S[parameters], landmark_covariance, np.diag(estimated))
        factors = np.sqrt(inflation)
        estimated = estimated * factors[:, None] * factors[None]
        covariance: Array = np.zeros((len(UNKNOWNS), len(UNKNOWNS)))
        covariance[np.ix_(self._free, self._free)] = estimated[:free_count, :free_count]
        zooms_covariance: Array = (
            estimated[free_count:, free_count:] if size == 7 else np.zeros((count, count))
        )
        # 2. Compute how the poses move if an unknown is held one unit too large.
        pose_slopes = -np.linalg.solve(S[:poses_size, :poses_size], S[:poses_size, poses_size:])
        pose_slopes = pose_slopes.reshape(count, size, free_count)
        # The camera centre -R^T t moves by -R^T rho with a twist (rho, phi) on the left of the pose.
        rho_to_centre = -state.T_camera_world[:, :3, :3].transpose(0, 2, 1)
        bends_m = np.zeros((len(UNKNOWNS), count, 3))
        bends_m[self._free] = np.einsum("kij,kjv->vki", rho_to_centre, pose_slopes[:, :3])
        return Calibrated(
            values=state.values,
            covariance=covariance,
            zooms=state.zooms,
            zooms_covariance=zooms_covariance,
            T_camera_world=state.T_camera_world,
            points_world=state.points,
            bends_m=bends_m,
            noise_m=self._path_noise_m(state, inverse_S[:poses_size, :poses_size], rho_to_centre),
            has_metric_scale=self.has_metric_scale,
            depth_factor=self.depth_factor,
        )

    def _variance_inflation(self, rows: Array, landmark_covariance: Array, variances: Array) -> Array:
        """Return the factors ``(p,)`` by which correlated residuals make *p* variances larger.

        Residuals of one landmark, of one part of the drive and of one region of the image are correlated.
        A factor is 1 plus, for each of these three clusterings, ``max(0, v / v0 - 1)``: v is the variance by
        the sandwich estimator (White 1980) with this clustering, and v0 that for independent residuals.

        Args:
            rows: ``(p, m)``, rows of the inverse of the reduced equations, one for each parameter.
            landmark_covariance: ``(l, 3, 3)``, covariances of the landmarks for fixed keyframes.
            variances: ``(p,)``, variances of the parameters with independent residuals.
        """
        # 1. Compute the influence (n, p) of each observation on each parameter.
        by_points = np.einsum("lar,lab->rlb", self._equations.E @ rows.T, landmark_covariance)
        by_keyframes = rows[:, : self._poses_size].reshape(
            len(rows), self._keyframe_count, self._keyframe_size
        )
        g_keyframe, g_values, g_points = (
            (J.transpose(0, 2, 1) @ self._r[:, :, None])[:, :, 0] for J in self._J
        )
        influence = g_values @ rows[:, self._poses_size :].T
        for parameter in range(len(rows)):
            influence[:, parameter] += (by_keyframes[parameter, self.keyframes] * g_keyframe).sum(axis=1)
            influence[:, parameter] -= (by_points[parameter, self.landmarks] * g_points).sum(axis=1)
        # 2. Cluster residuals by landmark, by part of the drive, and by region of the image.
        cell_size = self.camera.width / _IMAGE_CELLS, self.camera.height / _IMAGE_CELLS
        cells = np.clip(self.pixels // cell_size, 0, _IMAGE_CELLS - 1) @ (1, _IMAGE_CELLS)
        block_count = min(_TIME_BLOCKS, self._keyframe_count)
        clusterings = (
            (self.landmarks, self._landmark_count),
            (self.keyframes * block_count // self._keyframe_count, block_count),
            (cells.astype(np.int64), _IMAGE_CELLS**2),
        )
        # 3. Add the relative excess of each clustered variance over that for independent residuals.
        inflation = np.ones(len(rows))
        for clusters, count in clusterings:
            sums = sum_by_index(influence, clusters, count)
            clustered = (sums**2).sum(axis=0) * count / max(1, count - 1)
            inflation += np.maximum(clustered / np.maximum(variances, 1e-30) - 1.0, 0.0)
        return inflation

    def _path_noise_m(self, state: _State, poses_covariance: Array, rho_to_centre: Array) -> float:
        """Return the root mean square error of the path after alignment, m.

        The error is simulated: `_NOISE_SAMPLES` sets of errors of all poses are drawn from their covariance,
        with a fixed seed.

        Args:
            state: The adjusted poses.
            poses_covariance: Covariance of the parameters of all keyframes: their block of the covariance of
                all parameters.
            rho_to_centre: ``(k, 3, 3)``, maps the translation of a twist on the left of ``T_camera_world`` to
                the motion of the camera's centre in the world.
        """
        values, vectors = np.linalg.eigh(0.5 * (poses_covariance + poses_covariance.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        drawn = root @ np.random.default_rng(3).standard_normal((len(root), _NOISE_SAMPLES))
        twists = drawn.reshape(self._keyframe_count, self._keyframe_size, _NOISE_SAMPLES)
        moved = np.einsum("kij,kjs->ski", rho_to_centre, twists[:, :3])
        positions = inverse(state.T_camera_world)[:, :3, 3]
        squares = [
            rms_after_alignment(positions, sample, has_metric_scale=self.has_metric_scale) ** 2
            for sample in moved
        ]
        return float(np.sqrt(np.mean(squares)))


def rms_after_alignment(positions: Array, moved: Array, *, has_metric_scale: bool) -> float:
    """Return the root mean square of small displacements *moved* ``(k, 3)`` of a path after alignment, m.

    The small rigid motion of the whole path that fits the displacements best is subtracted before, together
    with a change of scale if *has_metric_scale* is False.

    Args:
        positions: ``(k, 3)``, positions of the path, m.
        moved: ``(k, 3)``, their displacements, m.
        has_metric_scale: Whether the path has a metric scale.
    """
    centred = positions - positions.mean(axis=0)
    J = np.concatenate([np.tile(np.eye(3), (len(centred), 1, 1)), -skew(centred)], axis=2).reshape(-1, 6)
    if not has_metric_scale:
        J = np.column_stack([J, centred.ravel()])
    flat = moved.reshape(-1)
    remaining = flat - J @ np.linalg.lstsq(J, flat, rcond=None)[0]
    return float(np.sqrt((remaining**2).sum() / len(centred)))
