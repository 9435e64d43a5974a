"""Judge a pose by how the image looks at the pixels where the pose expects landmarks.

Matches alone speak for a pose and never against it: a wallpaper that repeats matches on another wall as well,
while all else that was seen there is missing.  What is accepted is decided elsewhere.
"""

from __future__ import annotations

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.tracking.keyframe_map import Landmarks
from rse_pf.geometry import Array, inverse, transform
from rse_pf.slam.descriptors import distances_of_pairs
from rse_pf.slam.orb import describe_at
from rse_pf.slam.tracking import expect

__all__ = ["share_alike"]

_EDGE_PX = 40.0
"""No descriptor is computed nearer to the edge."""
_MOST = 300
_HIDDEN = 0.9
"""A landmark is hidden by what is nearer than this share of its depth."""
_ALIKE = 64
"""Largest Hamming distance, of 256 bits, between two looks of one landmark."""


def share_alike(frame: Frame, landmarks: Landmarks, T_world_camera: Array) -> tuple[float, int]:
    """Return which share of the landmarks that a pose expects looks as expected, and of how many.

    Landmarks that something nearer hides do not count; at most 300 are looked at.  Right poses of the
    recordings have 0.43 and more, also with blur; poses at another wall of the same paper have 0.13.
    """
    every = np.arange(len(landmarks.points))
    expected = expect(landmarks.looks, every, inverse(T_world_camera), frame.camera, -_EDGE_PX)
    sought = expected.features
    columns, rows = np.rint(sought.pixels).astype(np.int64).T
    measured_m = frame.depth_m[rows, columns]
    z = transform(inverse(T_world_camera), landmarks.points[expected.rows])[:, 2]
    seen = np.flatnonzero((measured_m <= 0.0) | (measured_m > _HIDDEN * z))
    if len(seen) > _MOST:
        seen = seen[np.linspace(0, len(seen) - 1, _MOST).astype(np.int64)]
    described, descriptors = describe_at(
        frame.rgb, sought.pixels[seen], sought.turns[seen], sought.sizes[seen]
    )
    if not len(described):
        return 0.0, 0
    distances = distances_of_pairs(descriptors, sought.descriptors[seen[described]])
    return float((distances <= _ALIKE).mean()), len(described)
