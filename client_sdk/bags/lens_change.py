"""Check whether two successive images show the change of the lens that a bag states between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import describe
from client_sdk.rigs.stereo_pair_checks import match_features
from rse_pf.geometry import Array, Lens

__all__ = ["mismatch_px"]

_EXTRACTED_FEATURES = 600  # number of features that are extracted from each image
_MIN_MATCHES = 30  # fewest matches of two images from which a change of the lens is checked
_ROTATION_FIT_ITERATIONS = 10  # iterations of the rotation fit, which is reweighted by a Cauchy loss

_Image = npt.NDArray[np.uint8]


def mismatch_px(before: _Image, after: _Image, lens: Lens, other: Lens) -> tuple[float, float] | None:
    """Return the median errors, px, of a pure rotation between two images, under two hypotheses on the lens.

    The first error assumes that the lens changed from *lens* to *other* between the images.  The second error
    assumes an unchanged lens, and is the smaller one of the errors with *lens* and with *other*.  The
    translation of the camera between two images is neglected: it moves pixels less than a wrong focal length
    does at the border.

    Returns:
        None if the images have fewer than 30 matches.
    """
    first, second = describe(before, _EXTRACTED_FEATURES), describe(after, _EXTRACTED_FEATURES)
    rows, others = match_features(first, second)
    if len(rows) < _MIN_MATCHES:
        return None
    seen, again = first.pixels[rows], second.pixels[others]
    changed, *unchanged = (
        _residual(one.unit_rays(seen), two.unit_rays(again)) * two.camera.fx
        for one, two in ((lens, other), (lens, lens), (other, other))
    )
    return changed, min(unchanged)


def _residual(rays: Array, others: Array) -> float:
    """Return the median angle, rad, between *rays* and *others* ``(n, 3)`` after the best rotation."""
    weights = np.ones(len(rays))
    angles = weights
    for _ in range(_ROTATION_FIT_ITERATIONS):
        u, _, vt = np.linalg.svd((others * weights[:, None]).T @ rays)
        rotation = u @ np.diag((1.0, 1.0, np.linalg.det(u @ vt))) @ vt
        angles = np.linalg.norm(rays @ rotation.T - others, axis=1)
        weights = 1.0 / (1.0 + np.square(angles / max(1e-9, float(np.median(angles)))))
    return float(np.median(angles))
