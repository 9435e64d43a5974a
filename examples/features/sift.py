"""SIFT instead of ORB: ``rse-pf demo --features sift:sift`` here, or ``robot.mapper(features=sift)``."""

import cv2
import numpy as np
import numpy.typing as npt

from client_sdk.plugins import FoundFeatures

_SIFT = cv2.SIFT_create(nfeatures=2000, contrastThreshold=0.02)


def sift(rgb: npt.NDArray[np.uint8]) -> FoundFeatures:
    """Find SIFT features of an image."""
    points, descriptors = _SIFT.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    return FoundFeatures(
        pixels=cv2.KeyPoint_convert(points), scores=[p.response for p in points], descriptors=descriptors,
        orientations_deg=[p.angle for p in points], sizes=[p.size / 2.0 for p in points],
    )  # fmt: skip
