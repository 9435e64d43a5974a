"""What a tracker computes for each frame: matches near predicted pixels, and the pose that fits landmarks.

Each function runs in the native core where its library is built, and in numpy elsewhere: matches are equal,
poses agree to rounding.  Which landmarks are sought, and what is done with a pose, is decided elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, exp_se3, skew, transform
from rse_pf.maps.descriptors import ORB, Descriptors
from rse_pf.native_tracker import track_core
from rse_pf.slam.descriptors import distance_matrix, distances_of_pairs, no_distance

__all__ = [
    "ExpectedFeatures",
    "FittedPose",
    "ImageFeatures",
    "LandmarkLooks",
    "NearLimits",
    "Observations",
    "SoughtFeatures",
    "distinct_by_numpy",
    "distinct_distances",
    "expect",
    "fit_pose",
    "fit_pose_by_numpy",
    "fit_sway",
    "fit_sway_by_numpy",
    "match_near",
    "match_near_by_numpy",
    "pairs_within",
    "seek_near",
]

Rows = npt.NDArray[np.int64]

_DTYPES = (np.uint8, np.int8)
_BAND = 1e6
_ITERATIONS, _FIRST_GATED, _CONVERGED = 10, 3, 1e-6
_NEAR_M = 0.05
_MAX_ABS, _MAX_TWIST, _MAX_DISTANCE2 = 1e9, 1e6, 1e300
_FREE = 1e-12
_OWN = 1e-9
_NEAREST_M = 0.1  # nearer landmarks are not sought
_MIN_COSINE = 0.6  # between the rays of two looks: from other directions a landmark looks different
_MAX_NEARER, _MAX_FARTHER = 2.0, 2.0  # ratios of distances: from others a landmark looks different


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageFeatures:
    """Features of one image.

    ``pixels`` ``(n, 2)``, undistorted; ``descriptors`` ``(n, d)``; ``turns`` ``(n, 2)``, cosine and sine of
    the orientation; ``sizes`` ``(n,)``, the scale of the pyramid's level, 1 for the finest; ``distinct``
    ``(n,)`` as `distinct_distances` returns it.  Turns and sizes tell nothing unless the features are
    *is_oriented* and *is_scaled*.
    """

    pixels: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array
    distinct: npt.NDArray[np.int32]
    is_oriented: bool = True
    is_scaled: bool = True

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SoughtFeatures:
    """Features that are expected in an image: their ``(m, 2)`` pixels, ``(m, 2)`` turns and ``(m,)`` sizes.

    ``turns`` are cosine and sine of the expected orientation.
    """

    pixels: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkLooks:
    """Points of the world, and how they looked in the last image that showed them.

    ``points`` ``(n, 3)``; ``rays`` ``(n, 3)`` from the camera that saw them last, and ``turns`` ``(n, 3)``
    their orientation there, in the world; ``sizes`` ``(n,)``; ``descriptors`` ``(n, d)``.
    """

    points: Array
    rays: Array
    turns: Array
    sizes: Array
    descriptors: Descriptors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedFeatures:
    """Landmarks as a pose expects them in its image: ``rows`` of the landmarks, and the features."""

    rows: Rows
    features: SoughtFeatures


@dataclass(frozen=True, slots=True, kw_only=True)
class NearLimits:
    """When a feature is the expected one.

    Attributes:
        radius_px: Around the expected pixel.
        ratio: The most similar feature must be this much nearer than the second within the radius.
        distinct_ratio: And this much nearer than the feature of its own image that resembles it most: a
            carpet or a wall of tiles looks alike beyond the radius, too.
        min_cosine: Between the expected orientation and its own.
        max_size_ratio: Between the expected size and its own, either way.
        max_distance: Largest Hamming distance, of 256 bits; other binary descriptors by their bits.  Vectors
            have none.
    """

    radius_px: float
    ratio: float = 0.8
    distinct_ratio: float = 0.8
    min_cosine: float = 0.9
    max_size_ratio: float = 1.35
    max_distance: int = 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Landmarks and what one image measured of them.

    Attributes:
        points: ``(n, 3)`` metres, world.
        spreads: ``(n, 3, 3)`` covariances of the points, square metres, world.
        pixels: ``(n, 2)``.
        pixels_px: ``(n,)`` deviations of the pixels.
        depths_m: ``(n,)`` along the optical axis, 0 where there is none.
        depths_dev_m: ``(n,)`` deviations of the depths; not read where there is none.
    """

    points: Array
    spreads: Array
    pixels: Array
    pixels_px: Array
    depths_m: Array
    depths_dev_m: Array

    def only(self, rows: Rows) -> Observations:
        """Return some of the rows."""
        return Observations(
            points=self.points[rows], spreads=self.spreads[rows], pixels=self.pixels[rows],
            pixels_px=self.pixels_px[rows], depths_m=self.depths_m[rows],
            depths_dev_m=self.depths_dev_m[rows],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedPose:
    """``T_camera_world``, the ``(6, 6)`` information of the twist on its left, and ``(n,)`` who agrees."""

    T_camera_world: Array
    information: Array
    is_inlier: npt.NDArray[np.bool_]


def distinct_distances(
    descriptors: Descriptors, pixels: Array, apart_px: float = 6.0
) -> npt.NDArray[np.int32]:
    """Return the distance of each feature to the most similar other one of its image.

    Features that are closer than *apart_px* in rows and columns are the same point, and are not compared.

    Args:
        descriptors: ``(n, d)``.
        pixels: ``(n, 2)``.
        apart_px: Of two features that are compared.

    Returns:
        ``(n,)``; where there is no other one a number above all distances, 256 of ORB.

    Raises:
        BadRequest: Shapes do not fit, or descriptors are neither uint8 nor int8.
    """
    is_fit = descriptors.ndim == 2 and len(descriptors) == len(pixels) and pixels.shape[1:] == (2,)
    if not is_fit or descriptors.dtype not in _DTYPES:
        raise BadRequest(
            f"{len(pixels)} features with descriptors of shape {descriptors.shape}, {descriptors.dtype}",
            hint="give a descriptor and two pixel coordinates for each feature",
        )
    core = track_core()
    if core is not None and ORB.describes(descriptors):
        return core.distinct(descriptors, pixels, apart_px)
    return distinct_by_numpy(descriptors, pixels, apart_px)


def distinct_by_numpy(descriptors: Descriptors, pixels: Array, apart_px: float) -> npt.NDArray[np.int32]:
    """Return what `distinct_distances` does, without the native core, whose oracle this is."""
    pixels = np.asarray(pixels, dtype=np.float64)
    distances, none = distance_matrix(descriptors, descriptors), no_distance(descriptors)
    with np.errstate(invalid="ignore", over="ignore"):
        apart = (np.abs(pixels[:, None] - pixels[None]) >= apart_px).any(axis=2)
    distances[~apart | np.eye(len(pixels), dtype=bool)] = none
    nearest: npt.NDArray[np.int32] = distances.min(axis=1, initial=none).astype(np.int32)
    return nearest


def match_near(sought: SoughtFeatures, image: ImageFeatures, limits: NearLimits) -> tuple[Rows, Rows]:
    """Return rows of *sought* and of *image* that match, by the rows of *sought*; deterministic, one to one.

    A feature or prediction at no finite place, or beyond 1e9 px, matches nothing.

    Raises:
        BadRequest: Shapes or the radius do not fit, or descriptors are no bytes.
    """
    m, n = len(sought.pixels), len(image)
    d = sought.descriptors.shape[1:]
    shapes = (
        sought.pixels.shape, sought.descriptors.shape, sought.turns.shape, sought.sizes.shape,
        image.pixels.shape, image.descriptors.shape, image.turns.shape, image.sizes.shape,
        image.distinct.shape,
    )  # fmt: skip
    if len(d) != 1 or shapes != ((m, 2), (m, *d), (m, 2), (m,), (n, 2), (n, *d), (n, 2), (n,), (n,)):
        raise BadRequest(
            "features of different numbers of rows, or kinds", hint="give one row of each for each feature"
        )
    if sought.descriptors.dtype not in _DTYPES or image.descriptors.dtype != sought.descriptors.dtype:
        raise BadRequest(
            f"descriptors of {sought.descriptors.dtype} and {image.descriptors.dtype}",
            hint="give uint8 or int8 of both",
        )
    if not 0.0 <= limits.radius_px <= _MAX_ABS:
        raise BadRequest(f"a radius of {limits.radius_px:g} px", hint="give 0 to 1e9 px")
    core = track_core()
    if core is None or not ORB.describes(image.descriptors):
        return match_near_by_numpy(sought, image, limits)
    return core.match_near(
        (sought.pixels, sought.turns, sought.sizes, sought.descriptors),
        (image.pixels, image.turns, image.sizes, image.descriptors, image.distinct),
        _numbers_of(limits, image),
    )  # fmt: skip


def expect(
    looks: LandmarkLooks, numbers: Rows, T_camera_world: Array, camera: Camera, margin_px: float
) -> ExpectedFeatures:
    """Return what a pose sees of landmarks: those ahead, in the image, and seen from such a place before.

    Args:
        looks: Of landmarks.
        numbers: ``(m,)`` rows of *looks*.
        T_camera_world: ``(4, 4)``.
        camera: Its intrinsics.
        margin_px: Around its image.
    """
    points = transform(T_camera_world, looks.points[numbers])
    ahead = np.flatnonzero(points[:, 2] > _NEAREST_M)
    pixels = camera.project(points[ahead])
    u, v = pixels.T
    inside = (
        (u > -margin_px) & (u < camera.width + margin_px) & (v > -margin_px) & (v < camera.height + margin_px)
    )
    ahead, pixels = ahead[inside], pixels[inside]
    distances = np.linalg.norm(points[ahead], axis=1)
    # The ray of the last look, in this camera's frame.
    rays = looks.rays[numbers[ahead]] @ T_camera_world[:3, :3].T
    before = np.linalg.norm(rays, axis=1)
    cosines = (rays * points[ahead]).sum(axis=1) / np.maximum(distances * before, 1e-9)
    is_alike = (
        (cosines > _MIN_COSINE) & (distances < _MAX_FARTHER * before) & (before < _MAX_NEARER * distances)
    )
    rows, pixels = ahead[is_alike], pixels[is_alike]
    turns = looks.turns[numbers[rows]] @ T_camera_world[:2, :3].T
    features = SoughtFeatures(
        pixels=pixels,
        descriptors=looks.descriptors[numbers[rows]],
        turns=turns / np.maximum(np.linalg.norm(turns, axis=1), 1e-9)[:, None],
        sizes=looks.sizes[numbers[rows]] * before[is_alike] / np.maximum(distances[is_alike], 1e-9),
    )
    return ExpectedFeatures(rows=rows, features=features)


def seek_near(
    looks: LandmarkLooks, numbers: Rows, T_camera_world: Array, camera: Camera, image: ImageFeatures,
    limits: NearLimits, margin_px: float,
) -> tuple[Rows, Rows]:  # fmt: skip
    """Return rows of *numbers* and of *image* that match where a pose expects landmarks, as `match_near`.

    Args:
        looks: Of landmarks.
        numbers: ``(m,)`` rows of *looks* that are sought.
        T_camera_world: ``(4, 4)``.
        camera: Its intrinsics.
        image: Where they are sought.
        limits: When a feature is the expected one.
        margin_px: Landmarks are expected so far around the image, too.
    """
    core = track_core()
    if core is None or not ORB.describes(image.descriptors):
        expected = expect(looks, numbers, T_camera_world, camera, margin_px)
        rows, features = match_near(expected.features, image, limits)
        return expected.rows[rows], features
    return core.seek(
        (looks.points, looks.rays, looks.turns, looks.sizes, looks.descriptors), numbers,
        (T_camera_world, camera, margin_px), (_NEAREST_M, _MIN_COSINE, _MAX_NEARER, _MAX_FARTHER),
        (image.pixels, image.turns, image.sizes, image.descriptors, image.distinct),
        _numbers_of(limits, image),
    )  # fmt: skip


def _numbers_of(limits: NearLimits, image: ImageFeatures) -> tuple[float, float, float, float, float, int]:
    """Return the limits in the order of the native core; features without turns have no limit of them."""
    return (
        limits.radius_px, limits.ratio, limits.distinct_ratio,
        limits.min_cosine if image.is_oriented else -np.inf,
        limits.max_size_ratio if image.is_scaled else np.inf, limits.max_distance,
    )  # fmt: skip


def match_near_by_numpy(
    sought: SoughtFeatures, image: ImageFeatures, limits: NearLimits
) -> tuple[Rows, Rows]:
    """Return what `match_near` does, without the native core, whose oracle this is."""
    radius_px, ratio, distinct_ratio, min_cosine, max_size_ratio, max_distance = _numbers_of(limits, image)
    empty = np.empty(0, dtype=np.int64)
    if not len(sought.pixels) or not len(image):
        return empty, empty
    with np.errstate(invalid="ignore", over="ignore"):
        rows, columns = pairs_within(
            np.asarray(sought.pixels, np.float64), np.asarray(image.pixels, np.float64), radius_px
        )
        a, b = np.asarray(sought.turns, np.float64)[rows], np.asarray(image.turns, np.float64)[columns]
        expected = np.asarray(sought.sizes, np.float64)[rows]
        size = np.asarray(image.sizes, np.float64)[columns]
        fits = (
            (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] >= min_cosine)
            & (size <= max_size_ratio * expected) & (expected <= max_size_ratio * size)
        )  # fmt: skip
    rows, columns = rows[fits], columns[fits]
    if not len(rows):
        return empty, empty
    distances = distances_of_pairs(sought.descriptors[rows], image.descriptors[columns])
    most = max_distance * image.descriptors.shape[1] // ORB.size
    if image.descriptors.dtype != np.uint8:
        most = no_distance(image.descriptors)
    order = np.lexsort((columns, distances, rows))
    rows, columns, distances = rows[order], columns[order], distances[order]
    starts = np.flatnonzero(np.concatenate(([True], rows[1:] != rows[:-1])))
    follows = np.minimum(starts + 1, len(rows) - 1)
    has_second = (rows[follows] == rows[starts]) & (follows > starts)
    best = distances[starts]
    clear = (
        (best <= most)
        & (best < distinct_ratio * image.distinct[columns[starts]])
        & (~has_second | (best < ratio * distances[follows]))
    )
    rows, columns, best = rows[starts][clear], columns[starts][clear], best[clear]
    nearest_first = np.argsort(best, kind="stable")
    _, firsts = np.unique(columns[nearest_first], return_index=True)
    chosen = np.sort(nearest_first[firsts])
    return rows[chosen].astype(np.int64), columns[chosen]


def fit_pose(
    observed: Observations,
    camera: Camera,
    T_camera_world: Array,
    *,
    cauchy: float = 2.5,
    gate2: float = 11.3,
) -> FittedPose | None:
    """Return the pose that fits pixels, depths and landmarks by the noise of all; None if it is free.

    Iterated least squares with a Cauchy weight; after three steps only rows within the gate count.  None as
    well where a number is not finite, or beyond what any camera measures: 1e9 m or px, depths of 1 km.

    Args:
        observed: Of one image.
        camera: Its intrinsics.
        T_camera_world: ``(4, 4)``, where the fit begins.
        cauchy: Distance in standard deviations at which a row weighs half.
        gate2: Squared distance beyond which a row does not agree: 11.3 keeps 99 % of three numbers.

    Raises:
        BadRequest: Shapes do not fit.

    Source:
        Errors in variables after Segal et al., Generalized-ICP (RSS 2009), here with pixels and depths.
    """
    n = len(observed.points)
    shapes = (
        observed.points.shape, observed.spreads.shape, observed.pixels.shape, observed.pixels_px.shape,
        observed.depths_m.shape, observed.depths_dev_m.shape, T_camera_world.shape,
    )  # fmt: skip
    if shapes != ((n, 3), (n, 3, 3), (n, 2), (n,), (n,), (n,), (4, 4)):
        raise BadRequest(
            "observations of different numbers of rows", hint="give one row for each landmark, and a 4x4 pose"
        )
    core = track_core()
    if core is None:
        return fit_pose_by_numpy(observed, camera, T_camera_world, cauchy=cauchy, gate2=gate2)
    fitted = core.fit_pose(*_packed(observed), camera, (cauchy * cauchy, gate2), T_camera_world)
    if fitted is None:
        return None
    return FittedPose(T_camera_world=fitted[0], information=fitted[1], is_inlier=fitted[2])


def _packed(observed: Observations) -> tuple[tuple[Array, Array], tuple[Array, Array, Array, Array]]:
    """Return points with the upper triangles of their covariances, and what was measured of them."""
    upper = observed.spreads.reshape(-1, 9)[:, (0, 1, 2, 4, 5, 8)]
    measured = observed.pixels, observed.pixels_px, observed.depths_m, observed.depths_dev_m
    return (observed.points, upper), measured


def fit_pose_by_numpy(
    observed: Observations, camera: Camera, T_camera_world: Array, *, cauchy: float, gate2: float
) -> FittedPose | None:
    """Return what `fit_pose` does, without the native core, whose oracle this is."""
    if not _is_whole(observed, camera, T_camera_world, (cauchy**2, gate2)):
        return None
    T = T_camera_world
    try:
        for iteration in range(_ITERATIONS):
            J, W, residual, distance2, is_inlier = _linearised(observed, camera, T, gate2)
            weight = 1.0 / (1.0 + distance2 / cauchy**2)
            if iteration >= _FIRST_GATED:
                weight = weight * is_inlier
            information = np.einsum("nia,nij,njb,n->ab", J, W, J, weight, optimize=True)
            gradient = np.einsum("nia,nij,nj,n->a", J, W, residual, weight, optimize=True)
            np.linalg.cholesky(information)
            twist = np.linalg.solve(information, gradient)
            if not np.abs(twist).max() <= _MAX_TWIST:
                return None
            T = exp_se3(twist) @ T
            if np.abs(twist).max() < _CONVERGED and iteration > _FIRST_GATED:
                break
        J, W, _, _, is_inlier = _linearised(observed, camera, T, gate2)
        information = np.einsum("nia,nij,njb,n->ab", J, W, J, is_inlier.astype(float), optimize=True)
        if not np.isfinite(T).all() or _has_free_motion(information):
            return None
    except np.linalg.LinAlgError:
        return None
    return FittedPose(T_camera_world=T, information=information, is_inlier=is_inlier)


def fit_sway(
    observed: Observations, sways: Array, camera: Camera, T_camera_world: Array, *, cauchy: float = 2.5
) -> tuple[float, float]:
    """Return by how much ``(n, 3)`` motions of the points explain what an image shows, and the information.

    It is solved beside the pose, by one step from the pose that fits; 0 and 0 where nothing can be said.

    Args:
        observed: Of one image; rows that agree with the pose.
        sways: ``(n, 3)``, how landmarks move in the camera's frame for a unit, less how measured points do.
        camera: Its intrinsics.
        T_camera_world: ``(4, 4)``, the pose that fits.
        cauchy: As in `fit_pose`.
    """
    core = track_core()
    if core is None:
        return fit_sway_by_numpy(observed, sways, camera, T_camera_world, cauchy=cauchy)
    return core.fit_sway(*_packed(observed), sways, camera, cauchy * cauchy, T_camera_world)


def fit_sway_by_numpy(
    observed: Observations, sways: Array, camera: Camera, T_camera_world: Array, *, cauchy: float
) -> tuple[float, float]:
    """Return what `fit_sway` does, without the native core, whose oracle this is."""
    J, W, residual, distance2, _ = _linearised(observed, camera, T_camera_world, np.inf)
    slopes = np.concatenate([J, J[:, :, :3] @ sways[:, :, None]], axis=2)
    weighted = (W @ slopes) / (1.0 + distance2 / cauchy**2)[:, None, None]
    information = np.tensordot(slopes, weighted, axes=((0, 1), (0, 1)))
    gradient = np.tensordot(weighted, residual, axes=((0, 1), (0, 1)))
    try:
        by_pose = np.linalg.solve(information[:6, :6], information[:6, 6])
    except np.linalg.LinAlgError:
        return 0.0, 0.0
    own = float(information[6, 6] - information[6, :6] @ by_pose)
    if not own > _OWN * float(information[6, 6]):
        return 0.0, 0.0
    return float(gradient[6] - by_pose @ gradient[:6]) / own, own


def _is_whole(observed: Observations, camera: Camera, T: Array, limits: tuple[float, float]) -> bool:
    """Return whether all numbers are finite and such as a camera measures."""
    has_depth = observed.depths_m > 0.0
    diagonals = observed.spreads[:, (0, 1, 2), (0, 1, 2)]
    anything = (observed.points, observed.pixels, observed.spreads, np.array([camera.cx, camera.cy]), T)
    within = (
        (np.array([camera.fx, camera.fy, limits[0]]), 1e-9, _MAX_ABS), (np.array(limits[1]), 0.0, _MAX_ABS),
        (diagonals, 0.0, _MAX_ABS), (observed.pixels_px, 1e-3, 1e6), (observed.depths_m, 0.0, 1e3),
        (observed.depths_dev_m[has_depth], 1e-6, 1e3),
    )  # fmt: skip
    return all((np.abs(numbers) <= _MAX_ABS).all() for numbers in anything) and all(
        ((numbers >= low) & (numbers <= high)).all() for numbers, low, high in within
    )


def _has_free_motion(information: Array) -> bool:
    """Return whether the information, scaled to a diagonal of 1, has no least eigenvalue to speak of.

    Points on a line have 1e-14 and less, a mark of 20 px, without depth, 1e-9.
    """
    diagonal = np.diag(information)
    if not ((diagonal >= 1e-300) & (diagonal <= 1e300)).all():
        return True
    scales = 1.0 / np.sqrt(diagonal)
    least = np.linalg.eigvalsh(information * scales[:, None] * scales)[0]
    return not least > _FREE


def _linearised(
    observed: Observations, camera: Camera, T: Array, gate2: float
) -> tuple[Array, Array, Array, Array, npt.NDArray[np.bool_]]:
    """Return slopes by the twist, weights, residuals, their squared distances, and who is within the gate."""
    has_depth = observed.depths_m > 0.0
    p = observed.points @ T[:3, :3].T + T[:3, 3]
    is_ahead = p[:, 2] > _NEAR_M
    p[:, 2] = np.maximum(p[:, 2], _NEAR_M)
    x, y, z = p.T
    n = len(p)
    residual = np.stack(
        [
            observed.pixels[:, 0] - (camera.fx * x / z + camera.cx),
            observed.pixels[:, 1] - (camera.fy * y / z + camera.cy),
            np.where(has_depth, observed.depths_m - z, 0.0),
        ],
        axis=1,
    )
    by_point = np.zeros((n, 3, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_point[:, 2, 2] = has_depth
    by_twist = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -skew(p)], axis=2)
    by_world = by_point @ T[:3, :3]
    variance = by_world @ observed.spreads @ by_world.transpose(0, 2, 1)
    variance[:, (0, 1), (0, 1)] += (observed.pixels_px**2)[:, None]
    variance[:, 2, 2] = np.where(has_depth, variance[:, 2, 2] + observed.depths_dev_m**2, 1.0)
    W = np.linalg.inv(variance)
    distance2 = np.einsum("ni,nij,nj->n", residual, W, residual)
    # A covariance that is none gives no distance, or a negative one.
    is_distance = (distance2 >= 0.0) & (distance2 <= _MAX_DISTANCE2)
    W = np.where(is_distance[:, None, None], W, 0.0)
    distance2 = np.where(is_distance, distance2, _MAX_DISTANCE2)
    return by_point @ by_twist, W, residual, distance2, (distance2 < gate2) & is_ahead


def pairs_within(predicted: Array, pixels: Array, radius_px: float) -> tuple[Rows, Rows]:
    """Return all pairs (row of predicted, row of pixels) within the radius.

    The pixels are sorted by bands of rows, and by column within a band, so that each prediction looks at a
    stretch of three bands only.
    """
    reach = radius_px + 1.0  # the sum of a pixel and a radius is rounded
    known = np.flatnonzero((np.abs(predicted) <= _MAX_ABS).all(axis=1))
    predicted = predicted[known]
    key = _key(np.floor(pixels[:, 1] / reach), pixels[:, 0])
    order = np.argsort(key, kind="stable")
    key = key[order]
    band = np.floor(predicted[:, 1] / reach)
    pairs: list[tuple[Rows, Rows]] = []
    for offset in (-1, 0, 1):
        first = np.searchsorted(key, _key(band + offset, predicted[:, 0] - reach))
        last = np.searchsorted(key, _key(band + offset, predicted[:, 0] + reach), side="right")
        counts = last - first
        rows = np.repeat(np.arange(len(predicted)), counts)
        offsets = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        columns = order[np.repeat(first, counts) + offsets]
        apart = pixels[columns] - predicted[rows]
        near = apart[:, 0] * apart[:, 0] + apart[:, 1] * apart[:, 1] <= radius_px * radius_px
        pairs.append((known[rows[near]], columns[near].astype(np.int64)))
    return np.concatenate([rows for rows, _ in pairs]), np.concatenate([columns for _, columns in pairs])


def _key(band: Array, x: Array) -> Array:
    """Return numbers that sort by band, then by column; columns far outside stay in their band."""
    key: Array = band * _BAND + np.clip(x, -0.4 * _BAND, 0.4 * _BAND)
    return key
