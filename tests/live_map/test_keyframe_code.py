"""The bytes of a keyframe's features."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Camera
from rse_pf.live_map.keyframe_code import (
    MAX_FEATURES,
    MAX_FEATURES_BYTES,
    decode_features,
    encode_features,
)

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def features(n: int, seed: int = 1, width: int = 640, height: int = 480):
    rng = np.random.default_rng(seed)
    return (
        rng.uniform(0, [width, height], (n, 2)),
        rng.uniform(0.3, 6.0, n),
        rng.integers(0, 256, (n, 32), dtype=np.uint8),
    )


def test_features_come_back_within_half_a_unit():
    pixels, depths_m, descriptors = features(800)

    found = decode_features(encode_features(pixels, depths_m, descriptors), CAMERA)

    assert len(found) == 800
    assert np.abs(found.pixels - pixels).max() <= 1 / 32 + 1e-5
    assert np.abs(found.depths_m - depths_m).max() <= 0.0005 + 1e-6
    assert np.array_equal(found.descriptors, descriptors)
    assert (found.pixels.dtype, found.depths_m.dtype) == (np.float32, np.float32)


def test_decoded_features_encode_to_the_same_bytes():
    once = encode_features(*features(300))
    found = decode_features(once, CAMERA)

    assert encode_features(found.pixels, found.depths_m, found.descriptors) == once


def test_rows_without_a_usable_depth_or_pixel_are_left_out():
    pixels, depths_m, descriptors = features(9)
    depths_m[:5] = [np.nan, 0.0, -1.0, np.inf, 70.0]
    pixels[5:7, 0] = [-3.0, np.nan]
    pixels[7, 1] = 20_000.0

    found = decode_features(encode_features(pixels, depths_m, descriptors), CAMERA)

    assert np.array_equal(found.descriptors, descriptors[8:])


def test_the_first_are_kept_where_there_are_too_many():
    pixels, depths_m, descriptors = features(2000)
    depths_m[:10] = 0.0

    data = encode_features(pixels, depths_m, descriptors)
    found = decode_features(data, CAMERA)

    assert len(data) <= MAX_FEATURES_BYTES < len(data) + 38
    assert np.array_equal(found.descriptors, descriptors[10 : 10 + MAX_FEATURES])


@pytest.mark.parametrize(("width", "step_px"), [(4000, 1 / 16), (8000, 1 / 8), (16_000, 1 / 4)])
def test_wide_images_have_coarser_pixels(width, step_px):
    pixels, depths_m, descriptors = features(200, width=width, height=3000)
    camera = Camera(fx=9000.0, fy=9000.0, cx=width / 2, cy=1500.0, width=width, height=3000)

    found = decode_features(encode_features(pixels, depths_m, descriptors), camera)

    assert step_px / 4 < np.abs(found.pixels - pixels).max() <= step_px / 2 + 1e-3


def test_an_image_without_depth_has_no_features():
    found = decode_features(encode_features(*features(0)), CAMERA)

    assert len(found) == 0
    assert found.points_camera(CAMERA).shape == (0, 3)


def test_points_lie_on_the_rays_of_the_pixels():
    found = decode_features(encode_features(*features(50)), CAMERA)

    points = found.points_camera(CAMERA)

    np.testing.assert_allclose(CAMERA.project(points), found.pixels, atol=1e-4)
    np.testing.assert_allclose(points[:, 2], found.depths_m)


def test_shapes_that_do_not_fit_are_refused():
    pixels, depths_m, descriptors = features(5)
    with pytest.raises(BadRequest, match="do not fit"):
        encode_features(pixels[:4], depths_m, descriptors)


def changed(data: bytes, at: int, form: str, value: int) -> bytes:
    damaged = bytearray(data)
    struct.pack_into(form, damaged, at, value)
    return bytes(damaged)


GOOD = encode_features(*features(20))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "bytes are not within"),
        (GOOD + bytes(MAX_FEATURES_BYTES), "bytes are not within"),
        (GOOD[:-1], "bytes are not 20 features"),
        (GOOD + b"\0", "bytes are not 20 features"),
        (changed(GOOD, 2, "<H", 65_535), "bytes are not 65535 features"),
        (changed(GOOD, 0, "<B", 2), "version 2"),
        (changed(GOOD, 1, "<B", 200), "is not known"),
        (changed(GOOD, 4, "<H", 65_535), "outside the image of 640x480"),
        (changed(GOOD, 4 + 20 * 4, "<H", 9), "below 10 mm"),
    ],
)
def test_malformed_features_are_refused_with_a_hint(data, why):
    with pytest.raises(BadRequest, match=why) as refused:
        decode_features(data, CAMERA)
    assert refused.value.hint
