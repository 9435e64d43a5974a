"""Numbers on the wire: what an array may be, in each encoding."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rse_pf.errors import BadMessage
from rse_pf.wire import CODECS, Command, as_type, make_codec
from rse_pf.wire.arrays import Array


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """A payload with one array."""

    values: Array


def over_the_wire(values: Any, codec: str) -> npt.NDArray[np.float64]:
    wire = make_codec(codec)
    message = wire.decode_from_robot(wire.encode(Command(id=1, service="s", payload={"values": values})))
    assert isinstance(message, Command)
    return as_type(message.payload, Sample).values


FLOATS = st.floats(-1e150, 1e150, allow_subnormal=True)
SIDE = 13
"""Each number may be one that takes long to read, of which a message may have 400."""


@pytest.mark.parametrize("codec", CODECS)
@given(values=hnp.arrays(np.float64, hnp.array_shapes(max_dims=2, max_side=SIDE), elements=FLOATS))
def test_float64_arrives_bit_for_bit_and_flat(codec: str, values: npt.NDArray[np.float64]) -> None:
    arrived = over_the_wire(values, codec)

    assert arrived.dtype == np.float64
    np.testing.assert_array_equal(arrived, values.ravel())


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("dtype", [np.float32, np.uint32, np.intp])
def test_other_numbers_arrive_as_float64(codec: str, dtype: type[Any]) -> None:
    arrived = over_the_wire(np.array([[0, 1], [65536, 3]], dtype=dtype), codec)

    assert arrived.dtype == np.float64
    np.testing.assert_array_equal(arrived, [0, 1, 65536, 3])


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("values", [[], [1, 2.5, -3], [2**60]])
def test_plain_lists_of_numbers_are_arrays_in_every_codec(codec: str, values: list[float]) -> None:
    np.testing.assert_array_equal(over_the_wire(values, codec), values)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "values",
    [["1.5"], [None], [True], [[1, 2]], [{}], "12", 5, None, {"a": 1}, [1, "x"], [1e200], [1e154, 1e154]],
    ids=repr,
)
def test_an_array_field_with_anything_but_a_flat_list_of_numbers_is_a_bad_message(
    codec: str, values: Any
) -> None:
    with pytest.raises(BadMessage) as caught:
        over_the_wire(values, codec)

    assert caught.value.hint


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numbers_that_are_not_finite_are_a_bad_message(number: float, dtype: type[Any]) -> None:
    with pytest.raises(BadMessage, match="not finite"):
        over_the_wire(np.array([1.0, number], dtype=dtype), "bin")


@pytest.mark.parametrize(
    ("dtype", "code"), [(np.float32, 1), (np.uint32, 2), (np.int64, 2), (np.float64, 3), (np.float16, 3)]
)
def test_an_array_is_its_raw_little_endian_bytes(dtype: type[Any], code: int) -> None:
    wire = make_codec("bin").encode(Command(id=1, service="s", payload=np.array([1, 258], dtype=dtype)))

    extension = msgspec.msgpack.decode(wire)["payload"]
    assert extension.code == code
    assert bytes(extension.data) == np.array([1, 258], dtype={1: "<f4", 2: "<u4", 3: "<f8"}[code]).tobytes()


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("values", [[-1, 2], [2**32], []])
def test_integers_beyond_uint32_keep_their_values(codec: str, values: list[int]) -> None:
    np.testing.assert_array_equal(over_the_wire(np.array(values, dtype=np.int64), codec), values)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("values", [np.array(["a"]), np.array([1j]), np.array([True]), np.array([None])])
def test_an_array_of_anything_but_numbers_cannot_be_encoded(codec: str, values: npt.NDArray[Any]) -> None:
    with pytest.raises(BadMessage):
        make_codec(codec).encode(Command(id=1, service="s", payload=values))


@pytest.mark.parametrize(
    ("code", "data"), [(1, b"123"), (2, b"12345"), (3, b"1234"), (4, b"1234"), (0, b""), (-2, b"")]
)
def test_an_extension_of_another_kind_or_length_is_a_bad_message(code: int, data: bytes) -> None:
    payload = msgspec.msgpack.Ext(code, data)
    wire = msgspec.msgpack.encode({"type": "command", "id": 1, "service": "s", "payload": payload})

    with pytest.raises(BadMessage) as caught:
        make_codec("bin").decode_from_robot(wire)
    assert caught.value.hint
