"""Appearance check of a recognised place: does the image look as the landmarks of the map predict?

Matches are evidence for a pose, but missing matches are not counted as evidence against it.  A repeating
wallpaper also matches at another wall, where most other landmarks that the pose predicts do not look as
predicted: this check counts them.
"""

from __future__ import annotations

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.tracking.keyframe_map import KeyframeMap
from rse_pf.geometry import Array, inverse, transform
from rse_pf.slam.descriptors import distances_of_pairs
from rse_pf.slam.orb import describe_at
from rse_pf.slam.tracking import predict_features

__all__ = ["has_predicted_appearance"]

_EDGE_PX = 40.0
"""Width of the border of an image, in pixels, whose landmarks are not compared: nearer to the edge, OpenCV
does not compute ORB descriptors."""
_MAX_LANDMARKS = 300
"""Largest number of landmarks whose appearance is compared, an even sample of all: bounds the time."""
_HIDDEN_DEPTH_SHARE = 0.9
"""A landmark is hidden, and not compared, if the depth measured at its predicted pixel is below this share of
the depth that the pose predicts for the landmark."""
_SIMILAR_BITS = 64
"""Largest Hamming distance, out of 256 bits, between the descriptor of a landmark and that of the image at
its predicted pixel, at which the landmark looks as predicted."""
_MIN_SIMILAR_SHARE = 0.25
"""Smallest share of the predicted landmarks that must look as predicted: right poses of the recordings have
0.43 and more, also with blur, and poses at another wall of the same paper have 0.13."""


def has_predicted_appearance(
    frame: Frame, segment_map: KeyframeMap, T_world_camera: Array, min_landmarks: int
) -> bool:
    """Return whether at least 25 % of the landmarks that a pose predicts look as predicted in a frame's
    image.

    Args:
        frame: Image with its depth; landmarks that something nearer hides are left out.  Where the depth is
            0, as everywhere in a stereo pair, no landmark counts as hidden.
        segment_map: Map of the place, whose landmarks have ORB descriptors.
        T_world_camera: ``(4, 4)``, the pose to check, in the world of the map.
        min_landmarks: Fewest landmarks that must be compared, after hidden ones were left out; with fewer the
            result is False.
    """
    # 1. Predict the landmarks, and leave out those that are hidden.
    T_camera_world = inverse(T_world_camera)
    landmarks, numbers = segment_map.landmarks_around(T_world_camera)
    rows, predicted = predict_features(landmarks, numbers, T_camera_world, frame.camera, -_EDGE_PX)
    columns, lines = np.rint(predicted.pixels).astype(np.int64).T
    measured_m = frame.depth_m[lines, columns]
    depths_m = transform(T_camera_world, landmarks.points[numbers[rows]])[:, 2]
    visible = np.flatnonzero((measured_m <= 0.0) | (measured_m > _HIDDEN_DEPTH_SHARE * depths_m))
    if len(visible) > _MAX_LANDMARKS:
        visible = visible[np.linspace(0, len(visible) - 1, _MAX_LANDMARKS).astype(np.int64)]
    # 2. Describe the image at the predicted pixels.
    described, descriptors = describe_at(
        frame.rgb, predicted.pixels[visible], predicted.orientations[visible], predicted.sizes[visible]
    )
    # 3. Compare the descriptors of the image with those of the landmarks.
    if not len(described) or len(described) < min_landmarks:
        return False
    distances = distances_of_pairs(descriptors, predicted.descriptors[visible[described]])
    return float((distances <= _SIMILAR_BITS).mean()) >= _MIN_SIMILAR_SHARE
