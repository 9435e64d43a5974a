"""Offer two robust PnP engines: the native core, and OpenCV's ``solvePnPRansac``, as in the RSE-PF paper.

Both engines need the native core: it measures the `Evidence` (inliers, covariance and the values of the
rules) of its own poses and of OpenCV's.  Engines are deterministic (fixed seeds, one thread), and raise
errors of this package only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np

from rse_pf.errors import BadRequest, ConfigurationError, MissingExtra
from rse_pf.geometry import Array, Camera
from rse_pf.pnp.native_solver import Evidence, NativeOptions, native_solver
from rse_pf.pnp.options import MIN_CORRESPONDENCES, PnpOptions, WeakLimits

__all__ = [
    "ENGINES",
    "Engine",
    "available_engines",
    "engine_for",
    "native_options",
]

# Most refinements of a pose by OpenCV, each over the inliers of the previous pose.  The refinements stop
# earlier if a refined pose has the same inliers as the previous one, or fewer than four.
_MAX_REFINEMENTS = 4
# Largest absolute coordinate (metres or pixels) that OpenCV receives; a request with a larger or non-finite
# number goes to the native core at once, which refuses it.
_MAX_ABS = 1e6

Engine = Callable[[Array, Array, Camera, PnpOptions, WeakLimits], Evidence]
"""A function of ``(points_world, pixels, camera, options, weak)`` that returns a pose with its evidence.

The points are ``(n, 3)`` metres in the world frame, the pixels ``(n, 2)`` and undistorted, both float64;
``n >= 4``.  An engine does not raise NoConsensus or DegenerateGeometry: it returns also a pose that a rule
refuses, with that error in ``Evidence.refusal``, and the caller raises the error.

Raises:
    BadRequest: A number is not finite or beyond 1e6.
"""


def engine_for(name: str) -> Engine:
    """Return the engine called *name*.

    Raises:
        BadRequest: There is no engine of this name.
        MissingExtra: The library of the engine is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    make = ENGINES.get(name)
    if make is None:
        raise BadRequest(f"no engine named {name!r}", hint=f"choose one of {', '.join(ENGINES)}")
    return make()


def available_engines() -> tuple[str, ...]:
    """Return the names of the engines whose libraries are installed and can be loaded."""
    names = []
    for name, make in ENGINES.items():
        try:
            make()
        except ConfigurationError:
            continue
        names.append(name)
    return tuple(names)


@cache
def _opencv_engine() -> Engine:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtra("opencv-python-headless", "vision") from error
    cv2.setNumThreads(1)
    solver = native_solver()

    def estimate(points_world: Array, pixels: Array, camera: Camera, options: PnpOptions) -> Array | None:
        """Return OpenCV's estimate of ``T_camera_world``, ``(4, 4)``; None if OpenCV finds no pose or fails.

        Source:
            RSE-PF paper, Sect. 6.1.
        """
        matrix = camera.matrix
        cv2.setRNGSeed(0)
        try:
            # 1. Find a pose and its inliers by RANSAC with P3P.
            has_pose, rotation, translation, inliers = cv2.solvePnPRansac(
                points_world,
                pixels,
                matrix,
                None,
                iterationsCount=options.max_iterations,
                reprojectionError=options.inlier_px,
                confidence=options.confidence,
                flags=cv2.SOLVEPNP_P3P,
            )
            if not has_pose or inliers is None or len(inliers) < MIN_CORRESPONDENCES:
                return None
            rows = inliers[:, 0]
            # 2. Estimate the pose again from the inliers by SQPnP, which finds the global minimum.
            # solvePnPRansac ends with EPnP, which for a planar scene may return the pose at the wrong one of
            # the two local minima of the reprojection error.
            has_global, global_rotation, global_translation = cv2.solvePnP(
                points_world[rows], pixels[rows], matrix, None, flags=cv2.SOLVEPNP_SQPNP
            )
            if has_global:
                rotation, translation = global_rotation, global_translation
            # 3. Refine the pose over its inliers by Levenberg-Marquardt, and find the inliers of the refined
            # pose among all rows; repeat this until the inliers stay the same, or `_MAX_REFINEMENTS` times.
            for _ in range(_MAX_REFINEMENTS):
                rotation, translation = cv2.solvePnPRefineLM(
                    points_world[rows], pixels[rows], matrix, None, rotation, translation
                )
                projected, _ = cv2.projectPoints(points_world, rotation, translation, matrix, None)
                error = projected[:, 0] - pixels
                is_inlier = (error * error).sum(axis=1) <= options.inlier_px**2
                previous_rows, rows = rows, np.flatnonzero(is_inlier)
                if len(rows) < MIN_CORRESPONDENCES or np.array_equal(previous_rows, rows):
                    break
            pose: Array = np.vstack([np.hstack([cv2.Rodrigues(rotation)[0], translation]), [0, 0, 0, 1]])
        except cv2.error:
            return None
        return pose

    def solve(
        points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
    ) -> Evidence:
        """Estimate a pose by OpenCV, and return it with the evidence that the native core measures."""
        pose = None
        if np.abs(points_world).max() <= _MAX_ABS and np.abs(pixels).max() <= _MAX_ABS:
            pose = estimate(points_world, pixels, camera, options)
        if pose is None:
            pose = np.full((4, 4), np.nan)  # A pose without inliers, which the native core refuses.
        return solver.evaluate(points_world, pixels, camera, native_options(options, weak), pose)

    return solve


@lru_cache(maxsize=64)
def native_options(options: PnpOptions, weak: WeakLimits) -> NativeOptions:
    """Return *options* and *weak* as options of the native core; ``options.engine`` is not used."""
    return NativeOptions(
        inlier_px=options.inlier_px,
        confidence=options.confidence,
        max_iterations=options.max_iterations,
        min_iterations=options.min_iterations,
        weak_inliers=weak.inliers,
        weak_inlier_ratio=weak.inlier_ratio,
        weak_translation_m=weak.translation_m,
        weak_rotation_rad=weak.rotation_rad,
    )


@cache
def _native_engine() -> Engine:
    solver = native_solver()

    def solve(
        points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
    ) -> Evidence:
        """Estimate a pose by LO-RANSAC with P3P and a robust refinement (``native/src/robust.hpp``)."""
        return solver.evaluate(points_world, pixels, camera, native_options(options, weak))

    return solve


ENGINES: dict[str, Callable[[], Engine]] = {
    "native": _native_engine,
    "opencv": _opencv_engine,
}
"""For each name of an engine the function that loads its library and returns the engine; the function raises
MissingExtra or ConfigurationError if that fails."""
