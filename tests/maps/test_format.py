"""The encoding of maps: it is exact and limited, and damaged bytes are rejected."""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.maps.format import MapLimits, decode_map, encode_map
from tests.kit.sample_maps import make_map


def test_a_decoded_map_equals_the_encoded_one() -> None:
    before = make_map()

    after = decode_map(encode_map(before))

    assert encode_map(after) == encode_map(before)
    for old, new in zip(before.keyframes, after.keyframes, strict=True):
        assert (old.id, old.robot, old.timestamp_s, old.camera) == (
            new.id,
            new.robot,
            new.timestamp_s,
            new.camera,
        )
        np.testing.assert_array_equal(old.T_world_camera, new.T_world_camera)
        np.testing.assert_array_equal(old.points_camera, new.points_camera)
        np.testing.assert_array_equal(old.descriptors, new.descriptors)
    np.testing.assert_array_equal(before.points, after.points)
    assert after.provenance == before.provenance


@pytest.mark.parametrize("cut", [0, 5, 8, 50, -1])
def test_a_truncated_map_is_refused(cut: int) -> None:
    with pytest.raises(BadRequest):
        decode_map(encode_map(make_map())[:cut])


def test_a_map_that_inflates_past_the_limit_is_refused() -> None:
    data = encode_map(make_map(points=100_000))

    with pytest.raises(BadRequest, match="more than 65536"):
        decode_map(data, 65_536)


def test_the_bytes_of_a_map_are_those_of_earlier_versions():
    sample, turned = make_map(), np.eye(4)[[1, 0, 2, 3]] * [[-1.0], [1.0], [1.0], [1.0]]
    version = replace(  # no pose that a linear-algebra library rounds
        sample,
        keyframes=tuple(replace(each, T_world_camera=turned) for each in sample.keyframes),
        edges=tuple(replace(each, T_a_b=turned) for each in sample.edges),
    )

    data = encode_map(version)

    assert hashlib.sha256(zlib.decompress(data[8:])).hexdigest().startswith("d1eef627677734ea")
    assert encode_map(decode_map(data)) == data


@pytest.mark.parametrize(
    ("limits", "problem"),
    [
        (MapLimits(keyframes=3), "4 keyframes is above 3"),
        (MapLimits(edges=2), "3 edges is above 2"),
        (MapLimits(keyframe_features=6), "7 features, which is above 6"),
        (MapLimits(features=27), "more than 27"),
    ],
)
def test_a_map_that_holds_more_than_the_limits_is_refused(limits, problem):
    data = encode_map(make_map())

    decode_map(data, limits=MapLimits(keyframes=4, edges=3, keyframe_features=7, features=28))
    with pytest.raises(LimitExceeded, match=problem):
        decode_map(data, limits=limits)
