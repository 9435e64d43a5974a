"""Two views of one camera that may only have turned: the rotation that explains the most matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, Camera

__all__ = ["RotationFit", "fit_rotation"]

_DRAWS = 64
"""Number of pairs of matches that RANSAC draws: if one rotation explains half of the matches, no drawn pair
consists of two of these with a probability of 0.75^64 = 1e-8."""
_SEED = 1  # seed of the draws: the same matches give the same rotation
_REFITS = 3  # number of fits to all matches that the rotation before explains; a fourth changes nothing
_MIN_DEPTH = 1e-6  # smallest depth of a rotated ray of length 1 that has a pixel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotationFit:
    """The rotation without translation that explains the most matches of two views.

    Attributes:
        R_second_first: ``(3, 3)``, maps directions in the first camera to directions in the second one.
        errors_px: ``(n,)``, distance of each pixel in the second view from the pixel to which the rotation
            moves its match in the first view; infinite for rays behind the second camera.
    """

    R_second_first: Array
    errors_px: Array


def fit_rotation(first: Array, second: Array, camera: Camera, *, inlier_px: float) -> RotationFit:
    """Find the rotation that explains the most matches of two views, by RANSAC with a fixed seed.

    Args:
        first: ``(n, 2)`` undistorted pixels in the first view, at least two.
        second: ``(n, 2)`` pixels of the same points in the second view.
        camera: Intrinsics of both views.
        inlier_px: Largest error of a match that a rotation explains.

    Source:
        TRIAD (Shuster and Oh 1981) for two matches; Markley, J. Astronaut. Sci. 1988, for more.
    """
    first_rays, second_rays = _unit_rays(first, camera), _unit_rays(second, camera)
    # 1. Propose no rotation, and the rotation of each drawn pair of matches.
    pairs = np.random.default_rng(_SEED).integers(0, len(first), (_DRAWS, 2))
    drawn = _frames(second_rays[pairs]) @ _frames(first_rays[pairs]).transpose(0, 2, 1)
    proposed = np.concatenate([np.eye(3)[None], drawn])
    errors_px = _errors_px(proposed, first_rays, second, camera)
    best = int((errors_px <= inlier_px).sum(axis=1).argmax())
    fit = RotationFit(R_second_first=proposed[best], errors_px=errors_px[best])
    # 2. Fit the best one to all matches that it explains, as long as it explains more of them.
    for _ in range(_REFITS):
        is_explained = fit.errors_px <= inlier_px
        rotation = _best_rotation(first_rays[is_explained], second_rays[is_explained])
        refitted_px = _errors_px(rotation[None], first_rays, second, camera)[0]
        if (refitted_px <= inlier_px).sum() < is_explained.sum():
            break
        fit = RotationFit(R_second_first=rotation, errors_px=refitted_px)
    return fit


def _unit_rays(pixels: Array, camera: Camera) -> Array:
    rays = camera.back_project(pixels, np.ones(len(pixels)))
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _frames(pairs: Array) -> Array:
    """Return a frame ``(k, 3, 3)`` for each pair of rays ``(k, 2, 3)``: its axes are the columns."""
    x = pairs[:, 0]
    normal = np.cross(x, pairs[:, 1])
    z = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _best_rotation(first_rays: Array, second_rays: Array) -> Array:
    """Return the rotation with the least sum of squared distances between rotated and measured rays."""
    left, _, right = np.linalg.svd(second_rays.T @ first_rays)
    proper = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    rotation: Array = left @ proper @ right
    return rotation


def _errors_px(rotations: Array, first_rays: Array, second: Array, camera: Camera) -> Array:
    """Return the errors ``(k, n)`` of n matches for each of k rotations."""
    rays = np.einsum("kij,nj->kni", rotations, first_rays)
    is_ahead = rays[..., 2] > _MIN_DEPTH
    rays[~is_ahead] = [0.0, 0.0, 1.0]
    pixels = camera.project(rays.reshape(-1, 3)).reshape(*is_ahead.shape, 2)
    return np.where(is_ahead, np.linalg.norm(pixels - second, axis=2), np.inf)
