"""Fuzz the keyframes of live maps: their decoding, and computations with their features.

Keyframes are decoded in the map server, so that their cost has the limits of a message of a robot.
"""

from __future__ import annotations

import struct

import numpy as np

from fuzz.checks import expect
from fuzz.meter import Meter
from rse_pf.errors import BadRequest, InvalidCamera
from rse_pf.geometry import Camera
from rse_pf.live_map.events import matrix_of
from rse_pf.live_map.measure import landmarks_of_features, measure_loop_closures, view_of_features
from rse_pf.slam.keyframe import (
    MAX_FEATURES,
    MAX_KEYFRAME_BYTES,
    SentKeyframe,
    decode_keyframe,
    encode_keyframe,
    make_features,
)
from rse_pf.slam.localise import LocalisationCandidate, localise
from rse_pf.slam.place_recognition import place_vector
from tests.kit.synthetic_maps import make_world

__all__ = ["live"]

_FEATURE_BYTES = 38  # size of an encoded feature
_UNITS_BYTES = 36  # size of the pixel and descriptor of an encoded feature
_DEPTHS_BYTES = 2  # size of the depth of an encoded feature


def live(data: bytes, meter: Meter) -> None:
    """Check that any bytes give a keyframe within bounds, or one of our errors.

    A keyframe is equal after encoding and decoding, and loop closures and place vectors computed from it hold
    finite numbers.  If the first byte is odd, valid heads are written here, and the other bytes are features.
    """
    if not data:
        return
    body = data[1:]
    if data[0] % 2:
        body = _with_heads(body, 2 + data[0] // 2 % 3)
    keyframe = meter.call(_decode, body, BadRequest)
    if keyframe is None:
        return
    features, camera = keyframe.features, keyframe.camera
    _check_keyframe(keyframe)
    again = encode_keyframe(keyframe)
    expect(len(again) <= MAX_KEYFRAME_BYTES, "an encoded keyframe that is too long")
    twice = decode_keyframe(again)
    for name in ("pixels", "depths_m", "descriptors"):
        expect(np.array_equal(getattr(twice.features, name), getattr(features, name)), f"{name} changed")
    for name in ("timestamp_s", "camera", "unknown_blocks"):
        expect(getattr(twice, name) == getattr(keyframe, name), f"{name} changed")
    vector = place_vector(features.descriptors)
    expect(bool(np.isfinite(vector).all()), "a vector that is not finite")
    view, known = (0, features, camera), (1, _KNOWN, _CAMERA)
    for measured, other in ((view, known), (known, view), (view, view)):
        links = measure_loop_closures(measured, [other]).links
        for link in links:
            expect(bool(np.isfinite(matrix_of(link.T_keyframe_other, 4, 4)).all()), "a pose not finite")
            information = matrix_of(link.information, 6, 6)
            expect(bool((np.linalg.eigvalsh(information) > 0.0).all()), "information that is not positive")
    candidates = [
        LocalisationCandidate(
            id=0, landmarks=landmarks_of_features(features, camera), T_map_keyframe=np.eye(4)
        ),
        LocalisationCandidate(
            id=1, landmarks=landmarks_of_features(_KNOWN, _CAMERA), T_map_keyframe=np.eye(4)
        ),
    ]
    found = localise(candidates, view_of_features(features, camera))
    expect((found.verdict == "none") == (found.T_map_camera is None), "a pose without a verdict")
    expect((found.verdict == "ok") == (found.reason == ""), "a verdict without its reason")
    if found.T_map_camera is not None and found.covariance is not None:
        expect(bool(np.isfinite(found.T_map_camera).all()), "a place that is not finite")
        expect(bool(np.isfinite(found.covariance).all()), "a covariance that is not finite")


def _decode(data: bytes) -> SentKeyframe:
    try:
        return decode_keyframe(data)
    except InvalidCamera as error:
        raise BadRequest(error.message, hint=error.hint) from error


def _with_heads(body: bytes, fraction: int) -> bytes:
    """Return *body* as the features of a keyframe, their pixels in units of ``2**-fraction``."""
    count = min(len(body) // _FEATURE_BYTES, MAX_FEATURES)
    units_end, end = _UNITS_BYTES * count, _FEATURE_BYTES * count
    empty = make_features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 32), np.uint8))
    begin = encode_keyframe(
        SentKeyframe(timestamp_s=0.0, T_odom_camera=np.eye(4), camera=_CAMERA, features=empty)
    )[: -8 - 8 - 4 - 8]
    return b"".join(
        (
            begin, struct.pack("<HHIBBHHBB", 2, 1, 8 + units_end, 1, 1, 32, count, fraction, 0),
            body[:units_end], struct.pack("<HHIBBH", 3, 1, 4 + _DEPTHS_BYTES * count, 1, 0, count),
            body[units_end:end],
        )
    )  # fmt: skip


def _check_keyframe(keyframe: SentKeyframe) -> None:
    features, camera = keyframe.features, keyframe.camera
    expect(len(features) <= MAX_FEATURES, "too many features")
    numbers = (features.pixels, features.depths_m, keyframe.T_odom_camera, features.points_camera(camera))
    expect(all(bool(np.isfinite(array).all()) for array in numbers), "a number that is not finite")
    expect(bool((features.depths_m >= 0.0099).all()), "a feature too near")
    expect(bool((features.pixels <= (camera.width + 64, camera.height + 64)).all()), "a pixel outside")


_WORLD, _ = make_world(7, points=1500).walk("robot-1", np.linspace(0.0, 0.05, 2), seed=2)
# Camera of the rendered keyframe.
_CAMERA: Camera = _WORLD.keyframes[0].camera
# Valid features of a rendered keyframe, with which decoded keyframes are matched.
_KNOWN = make_features(
    _WORLD.keyframes[0].pixels, _WORLD.keyframes[0].points_camera[:, 2], _WORLD.keyframes[0].descriptors
)
