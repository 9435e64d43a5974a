"""Two robust PnP engines behind one contract: the native core, and the paper's ``solvePnPRansac`` of OpenCV.

The native core judges the poses of both.  Engines are deterministic (fixed seeds, one thread) and raise no
exceptions of their libraries.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np

from rse_pf import native
from rse_pf.errors import BadRequest, ConfigurationError, MissingExtra
from rse_pf.geometry import Array, Camera
from rse_pf.pnp.options import PnpOptions, WeakLimits

__all__ = [
    "ENGINES",
    "Engine",
    "available_engines",
    "engine_for",
    "native_options",
]

# Refinements of the opencv engine, each on the inliers of the previous one.
_MAX_REFINEMENTS = 4
# Largest coordinate that OpenCV gets; the native core refuses larger ones, and those that are not finite.
_MAX_ABS = 1e6

Engine = Callable[[Array, Array, Camera, PnpOptions, WeakLimits], native.Evidence]
"""``(points_world (n, 3), pixels (n, 2), camera, options, weak)`` to a pose with its evidence; ``n >= 4``.

Raises:
    BadRequest: A number is not finite or absurd.
"""


def engine_for(name: str) -> Engine:
    """Return the engine called *name*.

    Raises:
        BadRequest: There is none.
        MissingExtra: Its library is not installed.
        ConfigurationError: Its library does not fit.
    """
    make = ENGINES.get(name)
    if make is None:
        raise BadRequest(f"no engine named {name!r}", hint=f"choose one of {', '.join(ENGINES)}")
    return make()


def available_engines() -> tuple[str, ...]:
    """Return the names of the engines whose libraries are installed and fit."""
    found = []
    for name, make in ENGINES.items():
        try:
            make()
        except ConfigurationError:
            continue
        found.append(name)
    return tuple(found)


@cache
def _opencv_engine() -> Engine:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtra("opencv-python-headless", "vision") from error
    cv2.setNumThreads(1)
    solver = native.native_solver()

    def propose(points_world: Array, pixels: Array, camera: Camera, options: PnpOptions) -> Array | None:
        """RANSAC with P3P, then Levenberg-Marquardt on the inliers (RSE-PF paper, Sect. 6.1)."""
        matrix = camera.matrix
        cv2.setRNGSeed(0)
        try:
            found, rotation, translation, inliers = cv2.solvePnPRansac(
                points_world, pixels, matrix, None,
                iterationsCount=options.max_iterations, reprojectionError=options.inlier_px,
                confidence=options.confidence, flags=cv2.SOLVEPNP_P3P,
            )  # fmt: skip
            if not found or inliers is None or len(inliers) < 4:
                return None
            rows = inliers[:, 0]
            # EPnP, which ends solvePnPRansac, may converge to the wrong one of a plane's two minima.
            found, better, shift = cv2.solvePnP(
                points_world[rows], pixels[rows], matrix, None, flags=cv2.SOLVEPNP_SQPNP
            )
            if found:
                rotation, translation = better, shift
            for _ in range(_MAX_REFINEMENTS):
                rotation, translation = cv2.solvePnPRefineLM(
                    points_world[rows], pixels[rows], matrix, None, rotation, translation
                )
                projected, _ = cv2.projectPoints(points_world, rotation, translation, matrix, None)
                error = projected[:, 0] - pixels
                agree = (error * error).sum(axis=1) <= options.inlier_px**2
                before, rows = rows, np.flatnonzero(agree)
                if len(rows) < 4 or np.array_equal(before, rows):
                    break
            pose: Array = np.vstack([np.hstack([cv2.Rodrigues(rotation)[0], translation]), [0, 0, 0, 1]])
        except cv2.error:
            return None
        return pose

    def solve(
        points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
    ) -> native.Evidence:
        """Judge the pose that OpenCV proposes."""
        pose = None
        if np.abs(points_world).max() <= _MAX_ABS and np.abs(pixels).max() <= _MAX_ABS:
            pose = propose(points_world, pixels, camera, options)
        if pose is None:
            pose = np.full((4, 4), np.nan)  # which agrees with no match
        return solver.judge(points_world, pixels, camera, native_options(options, weak), pose)

    return solve


@lru_cache(maxsize=64)
def native_options(options: PnpOptions, weak: WeakLimits) -> native.NativeOptions:
    """Return *options* and *weak* as the native core takes them."""
    return native.NativeOptions(
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
    solver = native.native_solver()

    def solve(
        points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
    ) -> native.Evidence:
        """LO-RANSAC with P3P, then robust refinement (``native/src/robust.hpp``)."""
        return solver.judge(points_world, pixels, camera, native_options(options, weak))

    return solve


ENGINES: dict[str, Callable[[], Engine]] = {
    "native": _native_engine,
    "opencv": _opencv_engine,
}
