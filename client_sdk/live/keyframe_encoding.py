"""Encode the keyframes that a robot sends to a live map: with metric depths, or up to scale."""

from __future__ import annotations

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
        features: Features of the frame.  Of those that have depth the first ones are encoded.
        max_orb_features: Limit of the number of ORB features; descriptors of more bytes have a lower limit.
        depth_noise: Noise of the camera's depths.
        imu: Gravity, and motion since the previous keyframe; None where they are not known.
        attachments: Points and image, of which the keyframe gets the references.
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
        points=attachments.points_reference,
        image=attachments.image_reference,
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
    """Encode a keyframe of a camera without depth, up to scale.

    Args:
        adjusted: Keyframe of the tracker, with depths in the unit of the odometry frame.  Features with a
            landmark, thus with a depth, are encoded before those without.
        T_odom_camera: ``(4, 4)`` pose of the camera in the odometry frame and its unit.
        camera: Intrinsics of the camera.
        max_orb_features: Limit of the number of ORB features; descriptors of more bytes have a lower limit.
        imu: Gravity, and motion since the previous keyframe; None where they are not known.
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
    """Return the limit of features of a kind: *max_orb_features* scaled by the size of its descriptors."""
    return max_orb_features * max_features(kind) // MAX_FEATURES
