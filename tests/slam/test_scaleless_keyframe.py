"""Keyframes of a camera without depth: their depths have no metric scale."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3
from rse_pf.slam.keyframe import (
    MAX_FEATURES,
    MAX_KEYFRAME_BYTES,
    SentKeyframe,
    decode_keyframe,
    encode_keyframe,
    make_scaleless_features,
)
from tests.slam.test_keyframe import CAMERA, changed


def keyframe(depths: Array, seed: int = 0) -> SentKeyframe:
    rng = np.random.default_rng(seed)
    n = len(depths)
    pixels = rng.uniform(0, [640, 480], (n, 2))
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    return SentKeyframe(
        timestamp_s=1.8e9,
        T_odom_camera=exp_se3([0.1, 0.2, -0.3, 0.1, 0.0, 0.2]),
        camera=CAMERA,
        features=make_scaleless_features(pixels, depths, descriptors),
    )


@pytest.mark.parametrize("unit", [1e-4, 0.5, 1.0, 40.0, 1e5])
def test_depths_of_any_unit_come_back_within_a_thousandth(unit: float) -> None:
    depths = unit * np.random.default_rng(1).uniform(0.5, 8.0, 300)
    made = keyframe(depths)
    data = encode_keyframe(made)

    found = decode_keyframe(data)

    assert not found.features.is_metric
    assert np.abs(found.features.depths_m / depths - 1.0).max() < 1e-3
    assert np.array_equal(found.features.depths_m, made.features.depths_m)
    assert encode_keyframe(found) == data


def test_features_without_a_depth_come_last_and_those_too_far_have_none() -> None:
    depths = np.r_[np.nan, 0.0, -1.0, np.inf, np.full(20, 2.0), 1000.0]

    found = decode_keyframe(encode_keyframe(keyframe(depths))).features

    assert len(found) == 25
    assert (found.depths_m[:20] > 0.0).all()
    assert (found.depths_m[20:] == 0.0).all()
    assert len(encode_keyframe(keyframe(np.full(2000, 2.0)))) < MAX_KEYFRAME_BYTES
    assert len(keyframe(np.full(2000, 2.0)).features) == MAX_FEATURES


GOOD = encode_keyframe(keyframe(np.linspace(1.0, 3.0, 20)))
UNIT_AT = len(GOOD) - 2 * 20 - 8


@pytest.mark.parametrize(
    ("at", "form", "value", "why"),
    [
        *((UNIT_AT, "<d", unit, "unit of depth") for unit in (math.nan, math.inf, -math.inf, -1.0, 0.0)),
        *((UNIT_AT, "<d", unit, "unit of depth") for unit in (1e-300, 1e300)),
        *((UNIT_AT - 2, "<H", count, "depths in") for count in (0, 19, 21, 65_535)),
    ],
)
def test_an_absurd_unit_or_number_of_depths_is_refused_in_one_line(
    at: int, form: str, value: float, why: str
) -> None:
    with pytest.raises(BadRequest, match=why) as refused:
        decode_keyframe(changed(at, form, value, GOOD))

    assert "\n" not in str(refused.value.message)


def test_a_keyframe_without_features_is_read_and_no_unit_is_made_of_absurd_depths() -> None:
    empty = decode_keyframe(encode_keyframe(keyframe(np.empty(0))))

    assert (len(empty.features), empty.features.is_metric) == (0, False)
    with pytest.raises(BadRequest, match="units of length of the segment"):
        keyframe(np.full(5, 1e-30))
    with pytest.raises(BadRequest, match="units of length of the segment"):
        keyframe(np.full(5, 1e30))
