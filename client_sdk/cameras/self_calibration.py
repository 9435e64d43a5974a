"""Calibrate a camera without a board: by structure from motion of the views of a moving camera.

Square pixels and a radial distortion of two coefficients are assumed.  Random numbers are seeded, but COLMAP
extracts and matches features in several threads: two calibrations by the same views differ by less than one
standard deviation.

Source:
    Incremental structure from motion: Schoenberger and Frahm, CVPR 2016, as COLMAP implements it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import CommandFailed, MissingExtra
from rse_pf.geometry import Array, Camera

__all__ = ["SelfCalibration", "calibrate_from_motion", "load_colmap"]

_Image = npt.NDArray[np.uint8]

MIN_VIEWS = 8  # fewest views of a calibration; with fewer, one wrong pose spoils the focal length
_MAX_FEATURES = 2000  # SIFT features of a view: more make matching slower, and the lens hardly better
_MATCHED_NEIGHBOURS = 10  # a view is matched with this many views after it; those further away overlap little
_MATCH_ERROR_PX = 2.0
"""Largest distance of a match from its epipolar line, px: a distortion that is not known yet bends the lines
by about a pixel."""
_HOMOGRAPHY_ERROR_PX = 4.0
"""Largest error of a match by a homography, px: an unknown distortion moves points by more than a pixel."""
_MIN_PAIR_MATCHES = 50  # a pair of views with fewer matches tells nothing about the kind of motion
_MAX_HOMOGRAPHY_SHARE = 0.85
"""A recording is refused if in the median pair a homography explains more than this share of the matches that
fit the epipolar geometry: the camera then only turns, or the scene is flat."""
_MAX_ROTATION_RESIDUAL = 0.35
"""Homographies are those of a camera that only turns if some focal length makes them rotations up to this
fraction of the motion, in the median; those of a plane leave about the motion itself."""
_TRIED_FOCAL_LENGTHS = (0.6, 0.8, 1.2, 2.0)
"""Focal lengths with which the reconstruction is started, as fractions of the longer side of the image: those
of wide lenses, of phones and webcams, and of telephoto lenses."""
_MIN_REGISTERED_SHARE = 0.75  # a start whose reconstruction has this share of the views is taken at once
_MIN_USED_SHARE = 0.5  # the best reconstruction needs this share of the views: the others do not overlap
_START_ANGLE_DEG = 2.0
"""Smallest median triangulation angle of the first pair of views, degrees: at the 16 degrees of COLMAP, views
of a camera that moves forward have hardly a match."""
_MAX_DISTORTION = 1.0  # largest absolute k1 or k2 of a lens that the radial model describes
_OUTLIER_PX = 3.0  # points with a larger reprojection error are left out of the last bundle adjustment
_MIN_POINT_ANGLE_DEG = 1.5  # points whose rays meet in a smaller angle are left out: their depth is unknown
_MAX_CENTRE_DEVIATION = 0.005
"""The principal point is estimated if its standard deviation for an image noise of 1 px is at most this
fraction of the longer side; otherwise the middle of the image is better."""
_JACKKNIFE_BLOCKS = 6
"""Number of blocks of successive views, each of which is left out once to find how much the lens depends on
them: fewer give an uncertain variance, and more take longer."""
_MODEL_FOCAL_DEVIATION_PERCENT = 0.3
"""Standard deviation of the focal length, in percent, by which real lenses differ from square pixels and two
coefficients: fx and fy of EuRoC's cameras differ by this much, and no residual shows it."""
_MAX_FOCAL_DEVIATION_PERCENT = 3.0
"""Largest standard deviation of the focal length, in percent of it, of a calibration that is not refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfCalibration:
    """Intrinsics, and the standard deviations of those of them that were estimated.

    Attributes:
        intrinsics: The calibration; ``views`` is the number of views in the reconstruction.
        standard_deviations: ``f``, ``cx``, ``cy`` in pixels, ``k1`` and ``k2`` without a unit.  Their squares
            are the sum of the variance of the bundle adjustment, which takes all errors of pixels as
            independent, the variance between parts of the recording (a jackknife over blocks of views), and
            for ``f`` the variance of the lens model.  ``cx`` and ``cy`` are missing if they were not
            estimated but set to the middle of the image.
    """

    intrinsics: Intrinsics
    standard_deviations: dict[str, float]


def load_colmap() -> Any:
    """Return the module ``pycolmap``, which logs fatal errors only from now on.

    Raises:
        MissingExtra: It is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise MissingExtra("pycolmap", "calibrate") from error
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    pycolmap.logging.logtostderr = True  # otherwise it writes log files
    return pycolmap


def calibrate_from_motion(
    views: Sequence[_Image],
    *,
    max_rms_px: float = 1.0,
    depth_scale: float | None = None,
    on_progress: Callable[[str], object] = lambda step: None,
) -> SelfCalibration:
    """Return the lens that explains the views of a moving camera best; this takes some minutes.

    Args:
        views: Grey images ``(h, w)`` of one size in the order of time, such as those of `select_views`.
        max_rms_px: Largest root mean square reprojection error, px, of a calibration that is accepted.
        depth_scale: Units of the camera's depth images per metre, which is copied into the result.
        on_progress: Is called with the name of each step when the step begins.

    Raises:
        CommandFailed: There are too few views, the camera only turns, the scene is flat, the views overlap
            too little, or the motion does not determine the focal length.
        MissingExtra: pycolmap or OpenCV is not installed.
    """
    colmap = load_colmap()
    if len(views) < MIN_VIEWS:
        raise CommandFailed(
            f"the camera moves too little: {len(views)} views with motion between them, and a calibration "
            f"needs {MIN_VIEWS}",
            hint="move the camera by a few percent of the distance to what it sees, or use a board: --board",
        )
    height, width = views[0].shape
    with tempfile.TemporaryDirectory(prefix="rse-pf-calibrate-") as word:
        folder = Path(word)
        on_progress("matching")
        _match(colmap, folder, views)
        _check_kind_of_motion(colmap, folder, width)
        on_progress("reconstructing")
        reconstruction = _reconstruct(colmap, folder, len(views))
    on_progress("adjusting")
    # 1. Estimate the principal point, and keep it only if the views determine it.
    refine_centre = True
    adjusted, variances, rms_px = _adjust(colmap, reconstruction, refine_centre=True)
    if variances is None or np.sqrt(variances[1:3].max()) > _MAX_CENTRE_DEVIATION * max(width, height):
        refine_centre = False
        adjusted, variances, rms_px = _adjust(colmap, reconstruction, refine_centre=False)
    # 2. Refuse a calibration that does not fit, or is not determined by these views.
    f, cx, cy, k1, k2 = (float(value) for value in adjusted.camera(1).params)
    if not rms_px <= max_rms_px:
        raise CommandFailed(
            f"the reprojection error is {rms_px:.2f} px, above {max_rms_px:g} px",
            hint="record with more light and slower, in a scene where nothing else moves",
        )
    deviations = np.full(1, np.inf)
    if variances is not None:
        between_parts = _jackknife_variances(colmap, adjusted, refine_centre=refine_centre)
        deviations = np.sqrt(rms_px**2 * variances + between_parts)
        deviations[0] = np.hypot(deviations[0], _MODEL_FOCAL_DEVIATION_PERCENT / 100 * f)
    deviation_percent = 100 * float(deviations[0]) / f
    if deviation_percent > _MAX_FOCAL_DEVIATION_PERCENT or max(abs(k1), abs(k2)) > _MAX_DISTORTION:
        raise CommandFailed(
            f"the motion does not determine the lens: k1 is {k1:.2f}, and the focal length {f:.0f} px is "
            f"uncertain by {deviation_percent:.1f} %, above {_MAX_FOCAL_DEVIATION_PERCENT:g} %",
            hint="move the camera sideways and turn it, near things at different distances; or use --board",
        )
    names = ("f", "k1", "k2") if len(deviations) == 3 else ("f", "cx", "cy", "k1", "k2")
    # 3. COLMAP's first pixel has its centre at (0.5, 0.5).
    camera = Camera(fx=f, fy=f, cx=cx - 0.5, cy=cy - 0.5, width=width, height=height)
    return SelfCalibration(
        intrinsics=Intrinsics(
            camera=camera,
            distortion=(k1, k2, 0.0, 0.0),
            depth_scale=depth_scale,
            rms_px=rms_px,
            views=int(adjusted.num_reg_images()),
        ),
        standard_deviations={name: float(value) for name, value in zip(names, deviations, strict=True)},
    )


def _match(colmap: Any, folder: Path, views: Sequence[_Image]) -> None:
    """Write the views, their SIFT features and verified matches into *folder*."""
    cv2 = load_opencv()
    images = folder / "images"
    images.mkdir()
    for row, view in enumerate(views):
        cv2.imwrite(str(images / f"{row:03}.png"), view)
    reading = colmap.ImageReaderOptions(camera_model="RADIAL")
    extraction = colmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _MAX_FEATURES
    extraction.sift.first_octave = 0  # not of the image at twice its size, which takes four times longer
    colmap.extract_features(
        folder / "database.db",
        images,
        camera_mode=colmap.CameraMode.SINGLE,
        reader_options=reading,
        extraction_options=extraction,
        device=colmap.Device.cpu,
    )
    pairing = colmap.SequentialPairingOptions(overlap=_MATCHED_NEIGHBOURS, quadratic_overlap=False)
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.max_error = _MATCH_ERROR_PX
    verification.ransac.random_seed = 0
    colmap.match_sequential(
        folder / "database.db",
        pairing_options=pairing,
        verification_options=verification,
        device=colmap.Device.cpu,
    )


def _check_kind_of_motion(colmap: Any, folder: Path, width: int) -> None:
    """Refuse views that a homography explains, and say whether the camera only turns or the scene is flat."""
    options = colmap.RANSACOptions(max_error=_HOMOGRAPHY_ERROR_PX, random_seed=0)
    shares, homographies = [], []
    with colmap.Database.open(folder / "database.db") as database:
        keypoints = {
            image.image_id: database.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            for image in database.read_all_images()
        }
        pair_ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        matches = geometry.inlier_matches
        if len(matches) < _MIN_PAIR_MATCHES:
            continue
        first, second = colmap.pair_id_to_image_pair(pair_id)
        pixels = keypoints[first][matches[:, 0]], keypoints[second][matches[:, 1]]
        found = colmap.estimate_homography_matrix(*pixels, options)
        shares.append(0.0 if found is None else found["num_inliers"] / len(matches))
        if found is not None:
            homographies.append(found["H"])
    if not shares:
        raise _too_little_overlap(0, len(keypoints))
    share = float(np.median(shares))
    if share <= _MAX_HOMOGRAPHY_SHARE:
        return
    if _rotation_residual(np.array(homographies), keypoints, width) <= _MAX_ROTATION_RESIDUAL:
        raise CommandFailed(
            f"the camera only turns: one rotation explains {100 * share:.0f} % of the matches of two views",
            hint="move the camera sideways by a few percent of the distance to what it sees, or use --board",
        )
    raise CommandFailed(
        f"the scene is flat: one plane explains {100 * share:.0f} % of the matches of two views",
        hint="show things at different distances, or use a board: --board",
    )


def _rotation_residual(H: Array, keypoints: dict[int, Array], width: int) -> float:
    """Return how far homographies ``(n, 3, 3)`` are from rotations, as a fraction of the motion.

    It is that of the focal length which fits best; the principal point is taken as the middle of the image.
    """
    centre = np.mean([pixels.mean(axis=0) for pixels in keypoints.values()], axis=0)
    H = H / np.cbrt(np.linalg.det(H))[:, None, None]
    residuals = []
    for f in np.geomspace(0.4, 3.0, 40) * width:
        K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
        R = np.linalg.inv(K) @ H @ K
        error = np.linalg.norm(np.swapaxes(R, 1, 2) @ R - np.eye(3), axis=(1, 2))
        motion = np.linalg.norm(R - np.eye(3), axis=(1, 2))
        residuals.append(float(np.median(error / np.maximum(motion, 1e-9))))
    return min(residuals)


def _too_little_overlap(views: int, of: int) -> CommandFailed:
    return CommandFailed(
        f"the views overlap too little: {views} of {of} can be reconstructed together",
        hint="move more slowly past things with texture, or record at a higher rate; or use --board",
    )


def _reconstruct(colmap: Any, folder: Path, views: int) -> Any:
    """Return the first of several reconstructions that has most of the views, or the one with most views.

    Each starts with another focal length.  A pair of views hardly determines a lens, so that the lens stays
    as it is until all views are registered; it is adjusted with all of them, and they are registered again.
    """
    best, most = None, 0
    for focal_length in _TRIED_FOCAL_LENGTHS:
        with colmap.Database.open(folder / "database.db") as database:
            (camera,) = database.read_all_cameras()
        f = focal_length * max(camera.width, camera.height)
        found = _map(colmap, folder, [f, camera.width / 2, camera.height / 2, 0.0, 0.0])
        if found is not None and found.num_reg_images() >= _MIN_USED_SHARE * views:
            adjusted, _, _ = _adjust(colmap, found, refine_centre=False)
            found = _map(colmap, folder, adjusted.camera(1).params)
        if found is not None and found.num_reg_images() > most:
            best, most = found, int(found.num_reg_images())
        if most >= _MIN_REGISTERED_SHARE * views:
            break
    if best is None or most < max(MIN_VIEWS, _MIN_USED_SHARE * views):
        raise _too_little_overlap(most, views)
    return best


def _map(colmap: Any, folder: Path, lens: Sequence[float]) -> Any | None:
    """Return the reconstruction with most views of a lens with the parameters *lens*; None without any."""
    with colmap.Database.open(folder / "database.db") as database:
        (camera,) = database.read_all_cameras()
        camera.params = lens
        camera.has_prior_focal_length = True  # otherwise the first pair of views decides it
        database.update_camera(camera)
    options = colmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=0, multiple_models=False, extract_colors=False, min_model_size=2
    )
    options.mapper.init_min_tri_angle = _START_ANGLE_DEG
    options.mapper.init_max_forward_motion = 1.0  # a car moves along the optical axis
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    found = colmap.incremental_mapping(folder / "database.db", folder / "images", folder, options)
    return max(found.values(), key=lambda each: each.num_reg_images(), default=None)


def _adjust(colmap: Any, reconstruction: Any, *, refine_centre: bool) -> tuple[Any, Array | None, float]:
    """Return a reconstruction after bundle adjustment and without outliers, with its error.

    Returns:
        The adjusted copy; the variances of the estimated parameters of the lens for an image noise of 1 px,
        None if the views do not determine them; and the root mean square reprojection error of a
        coordinate, px.
    """
    adjusted = colmap.Reconstruction(reconstruction)
    for _ in range(2):
        _solve(colmap, adjusted, refine_centre=refine_centre)
        colmap.ObservationManager(adjusted).filter_all_points3D(_OUTLIER_PX, _MIN_POINT_ANGLE_DEG)
    adjuster = _solve(colmap, adjusted, refine_centre=refine_centre)
    covariance = colmap.estimate_ba_covariance(colmap.BACovarianceOptions(), adjusted, adjuster)
    lens = None if covariance is None else covariance.get_other_params_cov(adjusted.camera(1).params)
    adjusted.update_point_3d_errors()
    squared = [point.error**2 * point.track.length() for point in adjusted.points3D.values()]
    rms_px = float(np.sqrt(sum(squared) / (2 * adjusted.compute_num_observations())))
    return adjusted, None if lens is None else np.diag(lens), rms_px


def _solve(colmap: Any, reconstruction: Any, *, refine_centre: bool) -> Any:
    """Adjust poses, points and lens of a reconstruction, and return the bundle adjuster."""
    options = colmap.BundleAdjustmentOptions(refine_principal_point=refine_centre, print_summary=False)
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    config = colmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = colmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    adjuster.solve()
    return adjuster


def _jackknife_variances(colmap: Any, adjusted: Any, *, refine_centre: bool) -> Array:
    """Return the variances of the estimated parameters of the lens that leaving out blocks of views shows.

    Errors of pixels that are alike in successive views, such as those of edges of objects, are not seen by
    the covariance of a bundle adjustment.

    Source:
        The delete-a-group jackknife: Kott, Journal of Official Statistics 2001.
    """
    lenses = []
    for block in np.array_split(sorted(adjusted.reg_image_ids()), _JACKKNIFE_BLOCKS):
        rest = colmap.Reconstruction(adjusted)
        for image_id in block:
            rest.deregister_frame(rest.image(int(image_id)).frame_id)
        _solve(colmap, rest, refine_centre=refine_centre)
        f, cx, cy, k1, k2 = rest.camera(1).params
        lenses.append([f, cx, cy, k1, k2] if refine_centre else [f, k1, k2])
    variances: Array = (_JACKKNIFE_BLOCKS - 1) * np.var(lenses, axis=0)
    return variances
