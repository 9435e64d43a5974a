"""The encoding of a keyframe's coloured points: round trips and rejected bytes."""

from __future__ import annotations

import hashlib
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.slam.keyframe import decode_keyframe, encode_keyframe
from rse_pf.slam.keyframe_points import (
    MAX_POINTS,
    MAX_POINTS_BYTES,
    ObjectReference,
    decode_points,
    encode_points,
)
from tests.slam.test_keyframe import CAMERA, keyframe

DIGEST = hashlib.sha256(b"points").hexdigest()


def some_points(n: int = 500, seed: int = 1):
    rng = np.random.default_rng(seed)
    places = np.sort(rng.choice(CAMERA.width * CAMERA.height, n, replace=False))
    pixels = np.column_stack((places % CAMERA.width, places // CAMERA.width))
    return pixels, rng.uniform(0.3, 3.5, n), rng.integers(0, 256, (n, 3), dtype=np.uint8)


def stated(n: int, content: bytes) -> bytes:
    """Return an object that states *n* points and holds the compressed *content*."""
    return struct.pack("<2sBBI", b"KP", 1, 0, n) + zlib.compress(content)


def one_point(step_px: int = 0, depth_mm: int = 1000) -> bytes:
    pixel, depth = struct.pack("<I", step_px), struct.pack("<H", depth_mm)
    return stated(1, pixel + depth + bytes(3))


def test_points_come_back_in_millimetres_with_their_colours() -> None:
    pixels, depths_m, colours = some_points()

    points, found = decode_points(encode_points(pixels, depths_m, colours, CAMERA), CAMERA)

    true = CAMERA.back_project(pixels.astype(np.float64), depths_m)
    assert np.abs(points - true).max() < 1e-3
    assert np.array_equal(found, colours)


def test_points_of_a_grid_take_few_bytes_each() -> None:
    v, u = np.mgrid[2:480:5, 2:640:5]
    pixels = np.column_stack((u.ravel(), v.ravel()))
    depths_m = 1.0 + 0.002 * pixels[:, 0]
    colours = np.repeat((pixels[:, :1] // 3).astype(np.uint8), 3, axis=1)

    data = encode_points(pixels, depths_m, colours, CAMERA)

    assert len(data) < 1.0 * len(pixels)


def test_more_points_than_allowed_are_thinned_evenly_and_bad_depths_left_out() -> None:
    pixels, depths_m, colours = some_points(MAX_POINTS + 5_000)
    depths_m[:3] = np.nan, np.inf, 1e30

    points, _ = decode_points(encode_points(pixels, depths_m, colours, CAMERA), CAMERA)

    assert len(points) == MAX_POINTS
    assert np.isfinite(points).all()
    rows = (points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy) // 120
    assert np.bincount(rows.astype(int), minlength=4).min() > 0.2 * MAX_POINTS


def test_a_keyframe_holds_references_and_an_older_reader_keeps_them() -> None:
    points, image = ObjectReference(DIGEST, 20_000), ObjectReference(DIGEST[::-1], 70_000)
    made = replace(keyframe(), points=points, image=image)

    found = decode_keyframe(encode_keyframe(made))

    assert (found.points, found.image) == (points, image)
    assert decode_keyframe(encode_keyframe(keyframe())).points is None
    assert len(encode_keyframe(made)) - len(encode_keyframe(keyframe())) == 2 * (8 + 36)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "0 bytes are not within"),
        (bytes(MAX_POINTS_BYTES + 1), "bytes are not within"),
        (b"PK" + one_point()[2:], "do not begin as points"),
        (stated(10**7, bytes(9 * 1000)), "10000000 points are above"),
        (stated(MAX_POINTS + 1, bytes(9)), "points are above"),
        (stated(2, bytes(9)), "they are not 2 points"),
        (stated(1, bytes(10)), "they are not 1 points"),
        (stated(1, bytes(10**8))[:MAX_POINTS_BYTES], "they are not 1 points"),
        (one_point() + b"more", "they are not 1 points"),
        (one_point()[:-3], "they are not 1 points"),
        (one_point()[:8] + b"\xff" * 20, "they are damaged"),
        (one_point(step_px=640 * 480), "outside the image"),
        (one_point(step_px=2**32 - 1), "outside the image"),
        (stated(2, struct.pack("<2Q", 0, 0)[:8] + bytes(10)), "occurs twice"),
        (one_point(depth_mm=0), "depth is below"),
    ],
)
def test_poisoned_points_are_refused_in_one_line(data: bytes, why: str) -> None:
    with pytest.raises(BadRequest, match=why) as refused:
        decode_points(data, CAMERA)
    assert "\n" not in refused.value.message
    assert refused.value.hint


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        (7, b""),
        (7, bytes(35)),
        (7, bytes(32) + struct.pack("<I", 0)),
        (7, bytes(32) + struct.pack("<I", 2**32 - 1)),
        (8, bytes(37)),
    ],
)
def test_a_reference_that_is_none_is_refused_with_its_keyframe(kind: int, content: bytes) -> None:
    data = bytearray(encode_keyframe(keyframe()))
    data[3] += 1
    with pytest.raises(BadRequest):
        decode_keyframe(bytes(data) + struct.pack("<HHI", kind, 0, len(content)) + content)
