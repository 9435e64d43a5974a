"""MessagePack that would weigh far more than its bytes is refused before it is made."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.errors import LimitExceeded
from rse_pf.wire import Command, make_codec
from rse_pf.wire.msgpack_limits import LIST_VALUES, MAP_VALUES, check_msgpack

SMALL = SessionSettings(max_json_values=64, max_json_lists=16)


def array_of(unit: bytes, count: int) -> bytes:
    return b"\xdd" + struct.pack(">I", count) + unit * count


def weight(value: Any) -> int:
    """Weigh a value by what it is, not by its bytes."""
    if isinstance(value, dict):
        return MAP_VALUES + sum(weight(k) + weight(v) for k, v in value.items())
    if isinstance(value, list):
        return LIST_VALUES + sum(map(weight, value))
    long = isinstance(value, bytes) or (isinstance(value, str) and len(value.encode()) > 31)
    return 2 if long else 1


def boxes(value: Any) -> int:
    inside = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    return isinstance(value, dict | list) + sum(map(boxes, inside))


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=40)
    | st.binary(max_size=300) | st.text(alphabet="x", min_size=200, max_size=300),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=40), inner, max_size=5),
    max_leaves=40,
)  # fmt: skip


@given(value=values)
def test_a_message_is_refused_exactly_when_what_it_holds_weighs_too_much(value):
    data = msgspec.msgpack.encode(value)
    too_much = weight(value) > SMALL.max_json_values or boxes(value) > SMALL.max_json_lists

    try:
        check_msgpack(data, SMALL)
    except LimitExceeded:
        assert too_much
    else:
        assert not too_much or len(data) <= SMALL.max_json_values // MAP_VALUES


@given(data=st.binary(max_size=500))
def test_counting_ends_for_bytes_that_are_not_messagepack(data):
    try:
        check_msgpack(data, SMALL)
    except LimitExceeded:
        assert len(data) > SMALL.max_json_values // MAP_VALUES


@pytest.mark.parametrize(
    "unit",
    [b"\x90", b"\x80", b"\xe0", b"\xd0\x80", b"\xa1z", b"\xd9\x01z", b"\xc4\x00", b"\xcb" + b"\x3f" * 8],
)
def test_every_kind_of_small_value_has_its_limit(unit):
    limits = SessionSettings(max_json_values=1000, max_json_lists=500)

    with pytest.raises(LimitExceeded):
        check_msgpack(array_of(unit, 1001), limits)


def test_raw_arrays_of_the_largest_message_are_two_values():
    codec = make_codec("bin")
    data = codec.encode(Command(id=1, service="pnp", payload=np.random.default_rng(3).random(32000)))

    check_msgpack(data, SessionSettings(max_json_values=64, max_json_lists=16))
    assert codec.decode_from_robot(data).id == 1


@pytest.mark.parametrize("codec", ["json", "bin"])
def test_numbers_have_a_limit_in_every_codec(codec):
    speak = make_codec(codec, SessionSettings(max_json_values=2000))
    fits = Command(id=1, service="echo", payload=[1.5] * 1900)
    too_many = Command(id=1, service="echo", payload=[1.5] * 2100)

    assert speak.decode_from_robot(speak.encode(fits)).id == 1
    with pytest.raises(LimitExceeded):
        speak.decode_from_robot(speak.encode(too_many))


def test_marks_within_a_word_are_no_values():
    codec = make_codec("json", SessionSettings(max_json_values=2000))
    text = ',:[{"\\' * 20000

    decoded = codec.decode_from_robot(codec.encode(Command(id=1, service="echo", payload=text)))

    assert decoded.payload == text
