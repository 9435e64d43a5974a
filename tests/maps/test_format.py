"""The encoding of a map: exact, bounded, and refused when damaged."""

from __future__ import annotations

import numpy as np
import pytest
from maps.sample_maps import make_map

from rse_pf.errors import BadRequest
from rse_pf.maps.format import decode_map, encode_map


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
