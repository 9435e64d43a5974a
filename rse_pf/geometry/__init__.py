"""Cameras, lenses and rigid transforms: the one convention of the platform.

The camera frame looks along +z, with x to the right and y down.  A pose ``T_a_b`` is a ``(4, 4)`` float64
matrix that maps points of frame *b* into frame *a*.  Lengths are in metres; where a text says so, they are in
the unit of a map or a trajectory without metric scale.  Angles are in radians.  Image coordinates are in
pixels, with the centre of the upper left pixel at (0, 0), x to the right and y down.

`transforms` holds rotations and poses, `camera` the pinhole camera, and `lens` the camera with its
distortion.
"""

from rse_pf.geometry.camera import Camera
from rse_pf.geometry.lens import LENS_MODELS, Lens, LensModel, find_lens_model, rectify_stereo_pair
from rse_pf.geometry.transforms import (
    Array,
    adjoint,
    body_poses,
    exp_se3,
    exp_so3,
    from_quaternion,
    inverse,
    left_jacobian_so3,
    log_se3,
    log_so3,
    median_pose,
    orthonormalise,
    planar_pose,
    pose_difference,
    right_jacobian_so3,
    rigid,
    rigid_many,
    rotation_angle_deg,
    scaled,
    skew,
    to_quaternion,
    transform,
)

__all__ = [
    "LENS_MODELS",
    "Array",
    "Camera",
    "Lens",
    "LensModel",
    "adjoint",
    "body_poses",
    "exp_se3",
    "exp_so3",
    "find_lens_model",
    "from_quaternion",
    "inverse",
    "left_jacobian_so3",
    "log_se3",
    "log_so3",
    "median_pose",
    "orthonormalise",
    "planar_pose",
    "pose_difference",
    "rectify_stereo_pair",
    "right_jacobian_so3",
    "rigid",
    "rigid_many",
    "rotation_angle_deg",
    "scaled",
    "skew",
    "to_quaternion",
    "transform",
]
