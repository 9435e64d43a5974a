"""Estimate the noise of a camera's depths from how well they fit the landmarks of the map.

A noise model gives the standard deviation of a depth.  That of a Kinect is constant up to 0.4 m, and grows
with the square of the depth beyond; that of a stereo pair grows with the square of the depth alone.  The
standard deviation of a camera is its model times one factor, which is estimated here: 1.7 for the Kinect of
the red-kitchen recording, 2.1 to 2.8 for that of TUM's fr1.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, transform
from rse_pf.pnp import DepthNoise
from rse_pf.slam.tracking import Observations

__all__ = ["NoiseEstimate"]

_INITIAL_FACTOR = 2.0
"""Factor of a camera's noise model before any image was measured: between those of two Kinects, 1.7 and
2.8."""
_MIN_FACTOR = 1.0
"""Smallest factor that one image gives: no camera is better than its model."""
_MAX_FACTOR = 4.0
"""Largest factor that one image gives: limits the effect of images with wrong depths on the running mean."""
_MIN_DEPTHS = 30
"""Fewest inliers with depth from which an image's noise is estimated."""
_NEWEST_WEIGHT = 0.05
"""Weight of the factor that the newest image gives in the running mean of the factors."""
_SIGMA_PER_MEDIAN = 1.4826
"""Standard deviation of a Gaussian divided by the median of its absolute values."""


class NoiseEstimate:
    """The factor by which a camera's depths are noisier than its model, a running mean over the images.

    ``factor`` multiplies standard deviations.  ``model`` is that of a Kinect until the tracker sets the model
    of its frames, such as that of a stereo pair.
    """

    def __init__(self) -> None:
        self.factor = _INITIAL_FACTOR
        self.model = DepthNoise()

    @property
    def noise(self) -> DepthNoise:
        """The noise of a depth that is measured now: the model times the factor."""
        return DepthNoise(
            base_m=self.factor * self.model.base_m,
            growth_per_m=min(1.0, self.factor * self.model.growth_per_m),
            from_m=self.model.from_m,
        )

    def add(self, observed: Observations, inliers: npt.NDArray[np.int64], T_camera_world: Array) -> None:
        """Update the estimate by one image; an image with fewer than 30 depths changes nothing.

        Args:
            observed: Observations of the image.
            inliers: Rows of *observed* that agree with the pose.
            T_camera_world: ``(4, 4)``, pose of the image.
        """
        rows = inliers[observed.depths_m[inliers] > 0.0]
        if len(rows) < _MIN_DEPTHS:
            return
        error_m = observed.depths_m[rows] - transform(T_camera_world, observed.points[rows])[:, 2]
        optical_axis = T_camera_world[2, :3]
        landmark_variance = np.einsum("i,nij,j->n", optical_axis, observed.covariances[rows], optical_axis)
        model_variance = self.model.variance_m2(observed.depths_m[rows])
        # The variance of the errors is the sum of those of the image and of the landmarks.  Both are divided
        # by the variance of the model; that of the landmarks is known, and subtracted.
        squared = (_SIGMA_PER_MEDIAN * float(np.median(np.abs(error_m) / np.sqrt(model_variance)))) ** 2
        image_squared = squared - float(np.median(landmark_variance / model_variance))
        factor = float(np.sqrt(np.clip(image_squared, _MIN_FACTOR**2, _MAX_FACTOR**2)))
        self.factor += _NEWEST_WEIGHT * (factor - self.factor)
