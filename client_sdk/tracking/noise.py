"""Estimate the noise of a depth camera from what it measures of known landmarks.

The model is that of the camera times one factor: a Kinect's 1.7 on the red-kitchen recording, 2.1 to 2.8 on
TUM's fr1; a stereo pair's has no floor and grows with the square of the depth.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, transform
from rse_pf.pnp import DepthNoise
from rse_pf.slam.tracking import Observations

__all__ = ["NoiseEstimate"]

_FIRST, _LEAST, _MOST = 2.0, 1.0, 4.0
_LEAST_ROWS = 30
_SHARE = 0.05
"""Of the newest image in the estimate."""
_OF_GAUSSIAN = 1.4826
"""Standard deviation of a Gaussian by its median distance from zero."""


class NoiseEstimate:
    """The factor by which a camera is noisier than its model says, over the last images.

    ``model`` is a Kinect's until another one is set.
    """

    def __init__(self) -> None:
        self.factor = _FIRST
        self.model = DepthNoise()

    @property
    def noise(self) -> DepthNoise:
        """The noise of a depth that is measured now."""
        return DepthNoise(
            base_m=self.factor * self.model.base_m,
            growth_per_m=min(1.0, self.factor * self.model.growth_per_m),
            from_m=self.model.from_m,
        )  # fmt: skip

    def add(self, observed: Observations, inliers: npt.NDArray[np.int64], T_camera_world: Array) -> None:
        """Take the depths of an image of landmarks that agree with its pose.

        Args:
            observed: Of one image.
            inliers: Rows that agree.
            T_camera_world: ``(4, 4)``, its pose.
        """
        rows = inliers[observed.depths_m[inliers] > 0.0]
        if len(rows) < _LEAST_ROWS:
            return
        error_m = observed.depths_m[rows] - transform(T_camera_world, observed.points[rows])[:, 2]
        axis = T_camera_world[2, :3]
        of_landmark = np.einsum("i,nij,j->n", axis, observed.spreads[rows], axis)
        of_model = self.model.variance_m2(observed.depths_m[rows])
        # The landmark's own share is known from before; what is left is this image's.
        deviation2 = (_OF_GAUSSIAN * float(np.median(np.abs(error_m) / np.sqrt(of_model)))) ** 2
        own2 = deviation2 - float(np.median(of_landmark / of_model))
        factor = float(np.sqrt(np.clip(own2, _LEAST**2, _MOST**2)))
        self.factor += _SHARE * (factor - self.factor)
