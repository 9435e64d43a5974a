"""The fuzz target of a live map's keyframes: their features, and what computes with them.

Features are decoded in the process that owns the map, so their cost has the bars of a robot's message.
"""

from __future__ import annotations

import struct

import numpy as np

from fuzz.checks import expect
from fuzz.meter import Meter
from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera
from rse_pf.live_map.events import matrix_of
from rse_pf.live_map.keyframe_code import (
    MAX_FEATURES,
    MAX_FEATURES_BYTES,
    KeyframeFeatures,
    decode_features,
    encode_features,
)
from rse_pf.live_map.measure import measure_links, reference_of_features, view_of_features
from rse_pf.services.synthetic_maps import make_world
from rse_pf.slam.localise import PlacedKeyframe, localise
from rse_pf.slam.places import place_vector

__all__ = ["live"]

_FEATURE_BYTES = 38


def live(data: bytes, meter: Meter) -> None:
    """Check that bytes as a keyframe's features give features within bounds, or BadRequest.

    Features survive encoding and decoding, and whatever they are, links and places come out with finite
    numbers.  An odd first byte means that the head is written here, so that the rest is taken as features.
    """
    if not data:
        return
    body = data[1:]
    if data[0] % 2:
        count = min(len(body) // _FEATURE_BYTES, MAX_FEATURES)
        body = struct.pack("<BBH", 1, 2 + data[0] // 2 % 3, count) + body[: count * _FEATURE_BYTES]
    features = meter.call(lambda sent: decode_features(sent, _CAMERA), body, BadRequest)
    if features is None:
        return
    _check_features(features)
    again = encode_features(features.pixels, features.depths_m, features.descriptors)
    expect(len(again) <= MAX_FEATURES_BYTES, "encoded features that are too many")
    twice = decode_features(again, _CAMERA)
    for name in ("pixels", "depths_m", "descriptors"):
        expect(np.array_equal(getattr(twice, name), getattr(features, name)), f"{name} changed")
    vector = place_vector(features.descriptors)
    expect(bool(np.isfinite(vector).all()), "a vector that is not finite")
    for keyframe, other in (((0, features), (1, _KNOWN)), ((1, _KNOWN), (0, features)), ((0, features),) * 2):
        links = measure_links((*keyframe, _CAMERA), [(*other, _CAMERA)]).links
        for link in links:
            expect(bool(np.isfinite(matrix_of(link.T_keyframe_other, 4, 4)).all()), "a pose not finite")
            information = matrix_of(link.information, 6, 6)
            expect(bool((np.linalg.eigvalsh(information) > 0.0).all()), "information that is not positive")
    candidates = [
        PlacedKeyframe(id=number, reference=reference_of_features(each, _CAMERA), T_map_keyframe=np.eye(4))
        for number, each in enumerate((features, _KNOWN))
    ]
    found = localise(candidates, view_of_features(features, _CAMERA))
    expect((found.verdict == "none") == (found.T_map_camera is None), "a pose without a verdict")
    expect((found.verdict == "ok") == (found.reason == ""), "a verdict without its reason")
    if found.T_map_camera is not None and found.covariance is not None:
        expect(bool(np.isfinite(found.T_map_camera).all()), "a place that is not finite")
        expect(bool(np.isfinite(found.covariance).all()), "a covariance that is not finite")


def _check_features(features: KeyframeFeatures) -> None:
    expect(len(features) <= MAX_FEATURES, "too many features")
    numbers = (features.pixels, features.depths_m, features.points_camera(_CAMERA))
    expect(all(bool(np.isfinite(each).all()) for each in numbers), "a feature that is not finite")
    expect(bool((features.depths_m >= 0.0099).all()), "a feature too near")
    expect(bool((features.pixels <= (_CAMERA.width + 64, _CAMERA.height + 64)).all()), "a pixel outside")


_WORLD, _ = make_world(7, points=1500).walk("robot-1", np.linspace(0.0, 0.05, 2), seed=2)
_CAMERA: Camera = _WORLD.keyframes[0].camera
_KNOWN = decode_features(
    encode_features(
        _WORLD.keyframes[0].pixels, _WORLD.keyframes[0].points_camera[:, 2], _WORLD.keyframes[0].descriptors
    ),
    _CAMERA,
)
