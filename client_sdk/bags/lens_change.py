"""Whether two images in succession show the change of the lens that is stated between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import describe
from client_sdk.rigs.stereo_pair_checks import match_features
from rse_pf.geometry import Array, Lens

__all__ = ["mismatch_px"]

_FEATURES = 600
_FEWEST_MATCHES = 30  # fewer matches tell no lens
_ITERATIONS = 10  # of the rotation that is fitted with the weights of a Cauchy loss

_Image = npt.NDArray[np.uint8]


def mismatch_px(before: _Image, after: _Image, lens: Lens, other: Lens) -> tuple[float, float] | None:
    """Return by how many pixels two images differ, in the median, apart from a rotation of the camera.

    The first number holds if the lens changed from *lens* to *other* between them, the second if it did not;
    for the second, the better of both lenses is taken.  A camera that drives on also moves by less than a
    wrong focal length shifts the border of an image.

    Returns:
        None if the images show too little.
    """
    first, second = describe(before, _FEATURES), describe(after, _FEATURES)
    rows, others = match_features(first, second)
    if len(rows) < _FEWEST_MATCHES:
        return None
    seen, again = first.pixels[rows], second.pixels[others]
    changed, *unchanged = (
        _residual(one.unit_rays(seen), two.unit_rays(again)) * two.camera.fx
        for one, two in ((lens, other), (lens, lens), (other, other))
    )
    return changed, min(unchanged)


def _residual(rays: Array, others: Array) -> float:
    """Return the median angle, rad, between rays ``(n, 3)`` and others after the rotation that fits best."""
    weights = np.ones(len(rays))
    angles = weights
    for _ in range(_ITERATIONS):
        u, _, vt = np.linalg.svd((others * weights[:, None]).T @ rays)
        rotation = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
        angles = np.linalg.norm(rays @ rotation.T - others, axis=1)
        weights = 1.0 / (1.0 + np.square(angles / max(1e-9, float(np.median(angles)))))
    return float(np.median(angles))
