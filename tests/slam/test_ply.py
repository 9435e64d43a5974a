"""PLY files: the decoder reads all that the encoder writes, and rejects other bytes at low cost."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.errors import BadRequest
from rse_pf.slam.ply import decode_ply, encode_ply

HEADER = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex %s\nproperty float x\nproperty float y\n"
    b"property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
)


def make_cloud(count: int, seed: int = 5) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 3.0, (count, 3)).astype(np.float32)
    return points, rng.integers(0, 256, (count, 3), dtype=np.uint8)


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("is_metric", [True, False])
def test_what_is_written_is_read_bit_by_bit(count: int, is_metric: bool) -> None:
    points, colours = make_cloud(count)

    data = encode_ply(points, colours, is_metric=is_metric)

    assert (b"comment metres\n" in data) is is_metric
    read_points, read_colours = decode_ply(data)
    assert read_points.dtype == np.float32
    assert read_colours.dtype == np.uint8
    np.testing.assert_array_equal(read_points, points)
    np.testing.assert_array_equal(read_colours, colours)


def test_a_cloud_of_another_program_is_read_without_its_other_numbers() -> None:
    kinds = (
        [(name, "<f8") for name in "xyz"] + [("nx", "<f4")] + [(c, "u1") for c in ("red", "green", "blue")]
    )
    rows = np.array([(1.0, 2.0, 3.0, 0.5, 10, 20, 30)], dtype=kinds)
    head = b"ply\nformat binary_little_endian 1.0\ncomment of another program\nelement vertex 1\n"
    head += b"".join(b"property double %c\n" % name for name in b"xyz") + b"property float nx\n"
    head += b"".join(b"property uchar %s\n" % name for name in (b"red", b"green", b"blue")) + b"end_header\n"

    points, colours = decode_ply(head + rows.tobytes())

    assert points.tolist() == [[1.0, 2.0, 3.0]]
    assert colours.tolist() == [[10, 20, 30]]


def test_a_file_that_is_cut_anywhere_is_refused() -> None:
    data = encode_ply(*make_cloud(3))

    for length in range(len(data)):
        with pytest.raises(BadRequest) as caught:
            decode_ply(data[:length])
        assert "\n" not in caught.value.message
        assert caught.value.hint


@pytest.mark.parametrize("count", [b"9" * 12, b"9" * 4000, b"-1", b"1e3", b"", b"\xd9\xa3"])
def test_a_number_of_points_that_is_not_there_costs_nothing(count: bytes) -> None:
    start = time.process_time()

    with pytest.raises(BadRequest):
        decode_ply(HEADER % count + bytes(15))

    assert time.process_time() - start < 0.1


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"binary_little_endian", b"ascii"),
        (b"property float x", b"property list uchar int x"),
        (b"property float x", b"property int x"),
        (b"property float y", b"property float x"),
        (b"property uchar red", b"property float red"),
        (b"element vertex 1", b"element face 1"),
        (b"property float x", b"element vertex 1\nproperty float x"),
        (b"end_header", b"comment " + b"x" * 5000 + b"\nend_header"),
    ],
)
def test_a_header_that_means_something_else_is_refused(old: bytes, new: bytes) -> None:
    data = HEADER % b"1" + bytes(15)
    assert len(decode_ply(data)[0]) == 1

    with pytest.raises(BadRequest):
        decode_ply(data.replace(old, new))


@given(st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), min_size=1, max_size=4))
def test_flipped_bytes_are_read_or_refused(flips: list[tuple[int, int]]) -> None:
    data = bytearray(encode_ply(*make_cloud(4)))
    for place, value in flips:
        data[place % len(data)] = value

    try:
        points, colours = decode_ply(bytes(data))
    except BadRequest:
        return
    assert points.shape == colours.shape
