"""Appearance check of a recognised place: does the image look as the landmarks of the map predict?

Matches are evidence for a pose, but missing matches are not counted as evidence against it.  A repeating
wallpaper also matches at another wall, where most other landmarks that the pose predicts do not look as
predicted: this check counts them.
"""

from __future__ import annotations

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.stereo.depth import stereo_points
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
"""Largest number of landmarks whose appearance is compared, those whose viewing ray changed least: bounds the
time."""
_HIDDEN_DEPTH_SHARE = 0.9
"""A landmark is hidden, and not compared, if the depth measured at its predicted pixel is at most this share
of the depth that the pose predicts for the landmark."""
_SIMILAR_BITS = 64
"""Largest Hamming distance, out of 256 bits, between the descriptor of a landmark and that of the image at
its predicted pixel, at which the landmark looks as predicted."""
_MIN_SIMILAR_SHARE = 0.4
"""Smallest share of the compared landmarks that must look as predicted: 25 of 26 right poses of MH_01 at
1 Hz and of KITTI 06 at 2 Hz have 0.43 or more, most poses at another wall of the same paper have less."""


def has_predicted_appearance(
    frame: Frame, segment_map: KeyframeMap, T_world_camera: Array, min_landmarks: int
) -> bool:
    """Return whether at least 40 % of the landmarks that a pose predicts look as predicted in a frame's
    image.

    Compared are the landmarks that the camera sees most nearly as their last image did: from another
    direction or distance, a landmark looks different at a right pose, too.

    Args:
        frame: Image with its depth, or a stereo pair.  A landmark is left out if something nearer hides it,
            or if no depth is measured at its predicted pixel.
        segment_map: Map of the place, whose landmarks have ORB descriptors.
        T_world_camera: ``(4, 4)``, the pose to check, in the world of the map.
        min_landmarks: Fewest landmarks that must be compared, after others were left out; with fewer the
            result is False.
    """
    # 1. Predict the landmarks, and keep those at whose pixel no nearer depth is measured.
    T_camera_world = inverse(T_world_camera)
    landmarks, numbers = segment_map.landmarks_around(T_world_camera)
    rows, predicted = predict_features(landmarks, numbers, T_camera_world, frame.camera, -_EDGE_PX)
    rays = transform(T_camera_world, landmarks.points[numbers[rows]])
    measured_m = _measure_depths(frame, predicted.pixels)
    visible = np.flatnonzero(measured_m > _HIDDEN_DEPTH_SHARE * rays[:, 2])
    # 2. Of these, take the landmarks whose viewing ray changed least since their last image.
    rays, last_rays = rays[visible], landmarks.rays[numbers[rows[visible]]] @ T_camera_world[:3, :3].T
    changes = np.linalg.norm(rays - last_rays, axis=1) / np.linalg.norm(rays, axis=1)
    visible = visible[np.argsort(changes, kind="stable")[:_MAX_LANDMARKS]]
    # 3. Describe the image at the predicted pixels.
    described, descriptors = describe_at(
        frame.rgb, predicted.pixels[visible], predicted.orientations[visible], predicted.sizes[visible]
    )
    # 4. Compare the descriptors of the image with those of the landmarks.
    if not len(described) or len(described) < min_landmarks:
        return False
    distances = distances_of_pairs(descriptors, predicted.descriptors[visible[described]])
    return float((distances <= _SIMILAR_BITS).mean()) >= _MIN_SIMILAR_SHARE


def _measure_depths(frame: Frame, pixels: Array) -> Array:
    """Return the depth of a frame at pixels ``(n, 2)``, metres; 0 or NaN where none is measured."""
    if frame.stereo is not None:
        return stereo_points(frame.rgb, frame.stereo, frame.camera, pixels)[:, 2]
    columns, lines = np.rint(pixels).astype(np.int64).T
    depths_m: Array = frame.depth_m[lines, columns]
    return depths_m
