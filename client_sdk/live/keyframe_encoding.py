"""Encode the keyframes that a robot sends to a live map: with metric depths, or up to scale."""

from __future__ import annotations

import hashlib

import numpy as np

from client_sdk.frontend import Features, Frame
from client_sdk.live.attachments import EncodedAttachments
from client_sdk.tracking.monocular_segment import AdjustedKeyframe
from rse_pf.geometry import Array, Camera
from rse_pf.maps.descriptors import DescriptorKind
from rse_pf.pnp import DepthNoise
from rse_pf.slam.inertial import KeyframeImu
from rse_pf.slam.keyframe import (
    MAX_FEATURES,
    SentKeyframe,
    encode_keyframe,
    make_features,
    make_scaleless_features,
    max_features,
)
from rse_pf.slam.keyframe_points import ObjectReference

__all__ = ["encode_depth_keyframe", "encode_monocular_keyframe"]


def encode_depth_keyframe(
    frame: Frame,
    T_odom_camera: Array,
    features: Features,
    *,
    max_orb_features: int,
    depth_noise: DepthNoise,
    imu: KeyframeImu | None,
    attachments: EncodedAttachments,
) -> bytes:
    """Encode a frame with depth, or a stereo pair, as a keyframe in metres.

    Args:
        frame: The frame; of a stereo pair the baseline is encoded, too.
        T_odom_camera: ``(4, 4)`` pose of the camera in the odometry frame, metres.
        features: Features of the frame.  Features without depth are left out; of the others, the first ones
            in this order are encoded up to the limit.
        max_orb_features: Most ORB features; of features with longer descriptors, proportionally fewer.
        depth_noise: Noise model of the camera's depths.
        imu: Gravity, and the motion since the previous keyframe by the IMU; None if they are not known.
        attachments: Points and image; the keyframe gets the digest and the size of each.
    """
    depths_m = features.points_camera[:, 2]
    rows = np.flatnonzero(np.isfinite(depths_m))[: _feature_limit(max_orb_features, features.kind)]
    f_baseline = 0.0 if frame.stereo is None else frame.camera.fx * frame.stereo.baseline_m
    keyframe = SentKeyframe(
        timestamp_s=frame.timestamp_s,
        T_odom_camera=T_odom_camera,
        camera=frame.camera,
        features=make_features(
            features.pixels[rows],
            depths_m[rows],
            features.descriptors[rows],
            depth_noise,
            features.kind,
            f_baseline,
        ),
        imu=imu,
        points=_refer_to(attachments.points),
        image=_refer_to(attachments.image),
    )
    return encode_keyframe(keyframe)


def encode_monocular_keyframe(
    adjusted: AdjustedKeyframe,
    T_odom_camera: Array,
    camera: Camera,
    *,
    max_orb_features: int,
    imu: KeyframeImu | None,
) -> bytes:
    """Encode a keyframe of a camera without depth, in the unit of its odometry frame.

    Args:
        adjusted: Keyframe of the tracker, with depths in the unit of the odometry frame.  Features with a
            landmark, which have a depth, come before those without, which are encoded only up to the limit.
        T_odom_camera: ``(4, 4)`` pose of the camera in the odometry frame, with the position in its unit.
        camera: Intrinsics of the camera.
        max_orb_features: Most ORB features; of features with longer descriptors, proportionally fewer.
        imu: Gravity, and the motion since the previous keyframe by the IMU; None if they are not known.
    """
    limit = _feature_limit(max_orb_features, adjusted.features.kind)
    rows = np.argsort(np.isnan(adjusted.depths), kind="stable")[:limit]
    keyframe = SentKeyframe(
        timestamp_s=adjusted.timestamp_s,
        T_odom_camera=T_odom_camera,
        camera=camera,
        features=make_scaleless_features(
            adjusted.features.pixels[rows],
            adjusted.depths[rows],
            adjusted.features.descriptors[rows],
            adjusted.features.kind,
        ),
        imu=imu,
    )
    return encode_keyframe(keyframe)


def _feature_limit(max_orb_features: int, kind: DescriptorKind) -> int:
    """Return the limit of features of *kind*: *max_orb_features*, or less if its descriptors are longer."""
    return max_orb_features * max_features(kind) // MAX_FEATURES


def _refer_to(data: bytes | None) -> ObjectReference | None:
    """Return digest and size of an attachment, as they are written into the keyframe; None for None."""
    return None if data is None else ObjectReference(hashlib.sha256(data).hexdigest(), len(data))
