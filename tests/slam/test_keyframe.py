"""The encoding of sent keyframes: round trips, unknown blocks, and rejected bytes."""

from __future__ import annotations

import math
import struct
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest, InvalidCamera
from rse_pf.geometry import Camera, exp_se3
from rse_pf.pnp import DepthNoise
from rse_pf.slam.keyframe import (
    MAX_BLOCKS,
    MAX_FEATURES,
    MAX_KEYFRAME_BYTES,
    SentKeyframe,
    UnknownBlock,
    check_odometry_range,
    decode_keyframe,
    encode_keyframe,
    make_features,
    make_scaleless_features,
)

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
POSE = exp_se3([1.0, -2.0, 3.0, 0.1, 0.2, 0.3])
HEAD, BLOCK = 108, 8
CAMERA_AT = HEAD + BLOCK
FEATURES_AT = CAMERA_AT + 38 + BLOCK


def random_features(n: int, seed: int = 1, width: int = 640, height: int = 480):
    rng = np.random.default_rng(seed)
    return (
        rng.uniform(0, [width, height], (n, 2)),
        rng.uniform(0.3, 6.0, n),
        rng.integers(0, 256, (n, 32), dtype=np.uint8),
    )


def keyframe(n: int = 20, camera: Camera = CAMERA) -> SentKeyframe:
    features = make_features(*random_features(n, width=camera.width, height=camera.height))
    return SentKeyframe(timestamp_s=1.8e9 + 0.25, T_odom_camera=POSE, camera=camera, features=features)


def assert_equal(one: SentKeyframe, other: SentKeyframe) -> None:
    assert (one.timestamp_s, one.camera, one.unknown_blocks) == (
        other.timestamp_s,
        other.camera,
        other.unknown_blocks,
    )
    assert np.array_equal(one.T_odom_camera, other.T_odom_camera)
    for name in ("pixels", "depths_m", "descriptors"):
        first, second = getattr(one.features, name), getattr(other.features, name)
        assert np.array_equal(first, second)
        assert first.dtype == second.dtype
    assert one.features.noise == other.features.noise


@pytest.mark.parametrize("n", [0, 1, 300, MAX_FEATURES])
def test_a_keyframe_comes_back_as_it_was(n: int) -> None:
    made = keyframe(n)
    data = encode_keyframe(made)

    found = decode_keyframe(data)

    assert_equal(found, made)
    assert encode_keyframe(found) == data
    assert len(data) == 108 + 3 * 8 + 38 + 8 + 4 + n * 38


def test_features_are_rounded_by_half_a_unit_at_most() -> None:
    pixels, depths_m, descriptors = random_features(800)

    found = make_features(pixels, depths_m, descriptors)

    assert len(found) == 800
    assert np.abs(found.pixels - pixels).max() <= 1 / 32 + 1e-5
    assert np.abs(found.depths_m - depths_m).max() <= 0.0005 + 1e-6
    assert np.array_equal(found.descriptors, descriptors)
    assert (found.pixels.dtype, found.depths_m.dtype) == (np.float32, np.float32)


def test_rows_without_a_usable_depth_or_pixel_are_left_out() -> None:
    pixels, depths_m, descriptors = random_features(9)
    depths_m[:5] = [np.nan, 0.0, -1.0, np.inf, 70.0]
    pixels[5:7, 0] = [-3.0, np.nan]
    pixels[7, 1] = 20_000.0

    assert np.array_equal(make_features(pixels, depths_m, descriptors).descriptors, descriptors[8:])


def test_optional_blocks_that_are_not_known_are_kept_byte_for_byte() -> None:
    made = replace(
        keyframe(),
        unknown_blocks=(UnknownBlock(10, b"new"), UnknownBlock(10, b""), UnknownBlock(65_535, bytes(200))),
    )
    data = encode_keyframe(made)

    found = decode_keyframe(data)

    assert found.unknown_blocks == made.unknown_blocks
    assert encode_keyframe(found) == data


def noisy(*numbers: float) -> bytes:
    """Return an encoded keyframe whose noise block holds these numbers."""
    whole = bytearray(encode_keyframe(keyframe()))
    whole[3] += 1
    content = struct.pack(f"<{len(numbers)}d", *numbers)
    return bytes(whole) + struct.pack("<HHI", 5, 0, len(content)) + content


def test_the_noise_of_the_depths_is_kept_among_blocks_that_are_not_known() -> None:
    noise = DepthNoise(base_m=0.0024, growth_per_m=0.0038)
    first = replace(keyframe(), unknown_blocks=(UnknownBlock(4, b"rig"), UnknownBlock(10, b"")))
    first = replace(first, features=replace(first.features, noise=noise))

    assert_equal(decode_keyframe(encode_keyframe(first)), first)
    assert decode_keyframe(noisy(0.0024, 0.0038, 0.4)).features.noise == noise
    assert encode_keyframe(decode_keyframe(noisy(0.0012, 0.0019, 0.4))) == encode_keyframe(keyframe())


@pytest.mark.parametrize(
    "numbers",
    [
        (math.nan, 0.0, 0.0),
        (math.inf, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.001, -1.0, 0.0),
        (0.001, 0.0, 1e9),
        (1.0,),
        (),
    ],
)
def test_a_noise_that_no_camera_has_is_refused(numbers: tuple[float, ...]) -> None:
    with pytest.raises(BadRequest):
        decode_keyframe(noisy(*numbers))


def test_a_required_block_that_is_not_known_is_refused_with_what_to_do() -> None:
    data = bytearray(encode_keyframe(keyframe()))
    data[3] += 1
    data += struct.pack("<HHI", 12, 1, 3) + b"abc"

    with pytest.raises(BadRequest, match="it needs block 12, which this release does not know") as refused:
        decode_keyframe(bytes(data))

    assert refused.value.hint == "update the server, or send the keyframe without this block"


def test_a_robot_that_is_farther_than_any_way_is_refused_and_a_map_of_a_survey_is_not() -> None:
    far = exp_se3([5.6e6, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = decode_keyframe(encode_keyframe(replace(keyframe(), T_odom_camera=far)))

    check_odometry_range(keyframe())
    with pytest.raises(BadRequest, match="more than 1000000 m from"):
        check_odometry_range(found)


GOOD = encode_keyframe(keyframe())


def changed(at: int, form: str, value: float, data: bytes = GOOD) -> bytes:
    damaged = bytearray(data)
    struct.pack_into(form, damaged, at, value)
    return bytes(damaged)


def with_blocks(count: int, size: int = 0) -> bytes:
    """Return an encoded keyframe with *count* additional optional blocks of *size* bytes."""
    return changed(3, "<B", 3 + count) + count * (struct.pack("<HHI", 7, 0, size) + bytes(size))


GEOMETRY_AT = FEATURES_AT + 8 + 20 * 36 + BLOCK


F_BASELINE = 380.0
"""Focal length times baseline of KITTI's stereo pair: 707 px times 0.54 m."""


def stereo_keyframe(n: int = 20) -> SentKeyframe:
    """Return a keyframe of a stereo pair whose points are 1.5 to 300 m away."""
    pixels, _, descriptors = random_features(n)
    depths_m = 1.5 * 200.0 ** np.linspace(0.0, 1.0, n)
    noise = DepthNoise(base_m=1e-5, growth_per_m=0.2 / F_BASELINE, from_m=0.0)
    features = make_features(pixels, depths_m, descriptors, noise, f_baseline=F_BASELINE)
    return SentKeyframe(timestamp_s=1.8e9, T_odom_camera=POSE, camera=CAMERA, features=features)


@pytest.mark.parametrize("n", [0, 1, 300, MAX_FEATURES])
def test_a_keyframe_of_a_stereo_pair_comes_back_as_it_was(n: int) -> None:
    made = stereo_keyframe(n)
    data = encode_keyframe(made)

    found = decode_keyframe(data)

    assert_equal(found, made)
    assert found.features.f_baseline == F_BASELINE
    assert encode_keyframe(found) == data
    assert len(data) <= 35_000


def test_points_of_a_stereo_pair_beyond_65_m_are_kept_to_a_64th_of_a_pixel() -> None:
    found = decode_keyframe(encode_keyframe(stereo_keyframe(100))).features

    assert len(found) == 100
    assert float(found.depths_m.max()) == pytest.approx(300.0, rel=0.01)
    error_px = F_BASELINE / found.depths_m - F_BASELINE / (1.5 * 200.0 ** np.linspace(0.0, 1.0, 100))
    assert float(np.abs(error_px).max()) <= 0.5 / 64 + 1e-4


def test_depths_that_no_disparity_has_are_left_out() -> None:
    depths_m = np.array([0.0, -1.0, math.nan, math.inf, 0.3, 5.0, 999.0, 1001.0])
    pixels, _, descriptors = random_features(len(depths_m))

    kept = make_features(pixels, depths_m, descriptors, f_baseline=F_BASELINE).depths_m

    # 0.3 m would have 1,267 px, and uint16 holds 1,023 of them.
    np.testing.assert_allclose(kept, [5.0], rtol=0.01)
    assert len(make_features(pixels, depths_m, descriptors, f_baseline=48.0)) == 2


def test_the_bytes_of_disparities_are_those_of_the_protocol() -> None:
    data = encode_keyframe(stereo_keyframe(2))
    at = FEATURES_AT + 8 + 2 * 36 + BLOCK

    assert data[at : at + 4] == bytes([2, 0, 2, 0])
    assert struct.unpack_from("<d2H", data, at + 4) == (F_BASELINE, 16_213, 81)


STEREO = encode_keyframe(stereo_keyframe())
SCALELESS = encode_keyframe(replace(keyframe(), features=make_scaleless_features(*random_features(20))))
DISPARITIES_AT = FEATURES_AT + 8 + 20 * 36 + BLOCK + 4


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "0 bytes is not within"),
        (GOOD + bytes(MAX_KEYFRAME_BYTES), "bytes is not within"),
        (with_blocks(2, 18_000), "bytes is not within"),
        (changed(0, "<B", 1), "does not begin as a keyframe of version 2"),
        (changed(2, "<B", 3), "does not begin as a keyframe of version 2"),
        (changed(3, "<B", 2), "bytes follow the last block"),
        (changed(3, "<B", 4), "ends within the head of a block"),
        (changed(3, "<B", 255), "255 blocks, more than 16"),
        (with_blocks(MAX_BLOCKS - 2), "17 blocks, more than 16"),
        (changed(4, "<d", math.nan), "its time .* is not within"),
        (changed(4, "<d", 1e13), "its time .* is not within"),
        (changed(12, "<d", math.nan), "no rigid motion"),
        (changed(12 + 3 * 8, "<d", math.inf), "no rigid motion"),
        (changed(12, "<d", 2.0), "no rigid motion"),
        (changed(HEAD, "<H", 0), "block 0 is repeated"),
        (changed(HEAD, "<H", 2), "block 2 is repeated"),
        (changed(HEAD, "<H", 12), "block 12"),
        (changed(HEAD + 2, "<H", 0), "block of the camera is not flagged"),
        (changed(HEAD + 2, "<H", 2), "unknown flags"),
        (changed(HEAD + 4, "<I", 2**32 - 1), "goes on beyond the end"),
        (changed(HEAD + 4, "<I", 37), "goes on beyond the end"),
        (changed(CAMERA_AT, "<B", 2), "camera 0 of model 2 is not known"),
        (changed(CAMERA_AT + 1, "<B", 1), "camera 1 of model 1 is not known"),
        (changed(FEATURES_AT, "<B", 2), "'' is no name of features"),
        (changed(FEATURES_AT + 1, "<B", 2), "detector 1, distance 2, with 32 bytes are not known"),
        (changed(FEATURES_AT + 2, "<H", 64), "descriptors of 64"),
        (changed(FEATURES_AT + 4, "<H", 65_535), "bytes are not 65535 features"),
        (changed(FEATURES_AT + 6, "<B", 200), r"2\*\*-200 px are not known"),
        (changed(FEATURES_AT + 7, "<B", 1), "bytes are not 20 features"),
        (changed(FEATURES_AT + 8, "<H", 65_535), "outside the image of 640x480"),
        (changed(GEOMETRY_AT, "<B", 7), "geometry of kind 7 is not known"),
        (changed(GEOMETRY_AT + 2, "<H", 19), "19 depths"),
        (changed(GEOMETRY_AT + 4, "<H", 9), "below 10 mm"),
        (changed(DISPARITIES_AT, "<d", math.nan, STEREO), "baseline, .* is not within 0.05..100000 px m"),
        (changed(DISPARITIES_AT, "<d", -F_BASELINE, STEREO), "baseline, .* is not within 0.05..100000 px m"),
        (changed(DISPARITIES_AT, "<d", math.inf, STEREO), "baseline, .* is not within 0.05..100000 px m"),
        (changed(DISPARITIES_AT, "<d", 0.0, STEREO), "baseline, .* is not within 0.05..100000 px m"),
        (changed(DISPARITIES_AT, "<d", 1e6, STEREO), "baseline, .* is not within 0.05..100000 px m"),
        (changed(DISPARITIES_AT, "<d", 1e4, STEREO), "are not within"),
        (changed(DISPARITIES_AT, "<d", 0.06, STEREO), "are not within"),
        (changed(DISPARITIES_AT + 8, "<H", 0, STEREO), "are not within"),
        (changed(DISPARITIES_AT + 8, "<H", 1, STEREO), "are not within"),
        (changed(DISPARITIES_AT - 4, "<B", 1, STEREO), "depths in 52 bytes"),
        (changed(DISPARITIES_AT - 2, "<H", 24, STEREO), "24 depths"),
    ],
)
def test_malformed_keyframes_are_refused_with_a_hint(data: bytes, why: str) -> None:
    with pytest.raises(BadRequest, match=why) as refused:
        decode_keyframe(data)
    assert refused.value.hint
    assert "\n" not in refused.value.message


@pytest.mark.parametrize("whole", [GOOD, STEREO, SCALELESS], ids=["depth", "stereo", "one lens"])
def test_a_keyframe_that_ends_early_is_refused_wherever_it_ends(whole: bytes) -> None:
    for size in range(len(whole)):
        with pytest.raises(BadRequest):
            decode_keyframe(whole[:size])


def mutants(data: bytes, count: int) -> list[bytes]:
    """Return copies of *data* with one to eight changed bytes, most of them in the heads."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(count):
        damaged = bytearray(data)
        end = len(data) if rng.uniform() < 0.3 else FEATURES_AT + 16
        for at in rng.integers(0, end, rng.integers(1, 9)):
            damaged[at] = int(rng.integers(0, 256))
        found.append(bytes(damaged))
    return found


def test_damaged_bytes_give_a_keyframe_within_bounds_or_an_error_of_ours() -> None:
    accepted = 0
    for data in mutants(GOOD, 3000):
        try:
            found = decode_keyframe(data)
        except (BadRequest, InvalidCamera):
            continue
        accepted += 1
        assert math.isfinite(found.timestamp_s)
        assert np.isfinite(found.T_odom_camera).all()
        assert np.isfinite(found.features.points_camera(found.camera)).all()
        assert_equal(decode_keyframe(encode_keyframe(found)), found)
    assert accepted > 20


def peak_of(act: Callable[[], object]) -> int:
    """Return the peak memory in bytes of a call of *act*."""
    tracemalloc.start()
    try:
        act()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def refused(data: bytes) -> None:
    with pytest.raises(BadRequest):
        decode_keyframe(data)


def test_a_refusal_takes_little_memory_and_time_whatever_the_bytes_promise() -> None:
    promising = [
        changed(HEAD + 4, "<I", 2**32 - 1),
        changed(FEATURES_AT + 4, "<H", 65_535),
        with_blocks(MAX_BLOCKS - 3)[:-1],
        changed(3, "<B", 255) + bytes(MAX_KEYFRAME_BYTES - len(GOOD)),
    ]
    for data in promising:
        refused(data)
        assert peak_of(lambda data=data: refused(data)) < 100_000
    began_s = time.process_time()
    for data in promising * 100:
        refused(data)
    assert time.process_time() - began_s < 2.0
