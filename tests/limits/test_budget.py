"""Bytes that would take far more memory or time than their size suggests are refused before decoding."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded
from rse_pf.limits.budget import (
    LIST_VALUES,
    MAP_VALUES,
    Budget,
    check_json,
    check_msgpack,
    inflate_within,
    measure_msgpack,
)
from rse_pf.wire import Command, make_codec

SHORT_NUMBERS = ("0.00012345678901234567", "-1.2345678901234567e-05", "1" * 19, "5e-99", "0." + "0" * 60)

SMALL = replace(Budget.of_messages(SessionSettings()), values=64, mixed_values=64, containers=16)


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
    too_much = weight(value) > SMALL.values or boxes(value) > SMALL.containers

    try:
        check_msgpack(data, SMALL)
    except LimitExceeded:
        assert too_much
    else:
        assert not too_much or len(data) <= SMALL.values // MAP_VALUES


@given(data=st.binary(max_size=500))
def test_counting_ends_for_bytes_that_are_not_messagepack(data):
    try:
        check_msgpack(data, SMALL)
    except (LimitExceeded, BadMessage):
        assert len(data) > SMALL.values // MAP_VALUES


@pytest.mark.parametrize(
    "unit",
    [b"\x90", b"\x80", b"\xe0", b"\xd0\x80", b"\xa1z", b"\xd9\x01z", b"\xc4\x00", b"\xcb" + b"\x3f" * 8],
)
def test_every_kind_of_small_value_has_its_limit(unit):
    limits = replace(SMALL, values=1000, mixed_values=1000, containers=500)

    with pytest.raises(LimitExceeded):
        check_msgpack(array_of(unit, 1001), limits)


@pytest.mark.parametrize("codec", ["json", "bin"])
def test_numbers_have_a_limit_in_every_codec(codec, monkeypatch):
    monkeypatch.setattr("rse_pf.limits.budget.MESSAGE_VALUES", 2000)
    speak = make_codec(codec)
    fits = Command(id=1, service="echo", payload=[1.5] * 1900)
    too_many = Command(id=1, service="echo", payload=[1.5] * 2100)

    assert speak.decode_from_robot(speak.encode(fits)).id == 1
    with pytest.raises(LimitExceeded):
        speak.decode_from_robot(speak.encode(too_many))


LONG_NUMBERS = ("1" * 20, "12345678901234567890.5e-30", "0." + "0" * 30 + "1" * 20, "-1." + "0" * 19)


def is_within(text: str) -> bool:
    try:
        check_json(text.encode(), Budget.of_messages(SessionSettings()))
    except LimitExceeded:
        return False
    return True


@pytest.mark.parametrize("number", LONG_NUMBERS)
def test_few_numbers_may_have_more_than_19_digits(number):
    def numbers(count):
        return "[" + f"{number}, " * count + "1," * 5000 + "1]"

    assert is_within(numbers(400))
    assert not is_within(numbers(401))
    assert is_within('["' + numbers(1000) + '", "' + "x" * 9000 + '"]'), "it is a text"


@pytest.mark.parametrize("number", SHORT_NUMBERS)
def test_many_numbers_may_have_19_digits(number):
    assert is_within("[" + f"{number}," * 10_000 + "1]")


@pytest.mark.parametrize("number", ["5e-324", "1.7E308", "0.1e+0100"])
def test_few_numbers_may_have_an_exponent_of_three_digits(number):
    assert is_within("[" + f"{number}," * 199 + number + "]")
    assert not is_within("[" + f"{number}," * 200 + number + "]")


WIDE = Budget(
    wire_bytes=1 << 20, inflated_bytes=1 << 20, inflate_ratio=20.0, free_bytes=1 << 14, depth=8,
    containers=1000, values=100_000, mixed_values=2000, memory_bytes=1 << 20,
)  # fmt: skip
LONG = "x" * WIDE.mixed_values
"""A text that makes a message long enough to be read."""


def nested(depth: int, inmost: Any = None) -> Any:
    return inmost if depth == 0 else [nested(depth - 1, inmost)]


@pytest.mark.parametrize("inmost", [None, [], {}, [7] * 100, {"a": 1}])
def test_the_depth_is_validated_on_the_bytes(inmost):
    levels = WIDE.depth - (inmost is not None)
    fits = msgspec.msgpack.encode({"text": LONG, "deep": nested(levels - 1, inmost)})
    too_deep = msgspec.msgpack.encode({"text": LONG, "deep": nested(levels, inmost)})

    assert check_msgpack(fits, WIDE)
    with pytest.raises(LimitExceeded, match="deeper than 8"):
        check_msgpack(too_deep, WIDE)


@pytest.mark.parametrize("depth", [1001, 100_000])
def test_a_list_that_is_too_deep_for_the_decoder_is_refused(depth):
    with pytest.raises(LimitExceeded, match="deeper"):
        check_msgpack(b"\x91" * depth + b"\x01" * 1000, WIDE)


@given(value=values)
def test_a_value_within_a_message_is_measured_to_its_last_byte(value):
    data = msgspec.msgpack.encode(value)

    assert measure_msgpack(b"..." + data + b"\x01\x02", 3, WIDE) == 3 + len(data)
    for end in {0, len(data) // 2, len(data) - 1}:
        with pytest.raises(BadMessage, match="ends within"):
            measure_msgpack(data[:end], 0, WIDE)


@pytest.mark.parametrize(
    "data",
    [
        b"\xdb\xff\xff\xff\xff", b"\xc6\x00\x10\x00\x00", b"\xc9\xff\xff\xff\xff\x01",
        b"\xdd\x7f\xff\xff\xff",
        b"\xdf\x7f\xff\xff\xff", b"\xdc\xff", b"\xc7", b"\xcb\x00", b"\xd8\x01", b"\xde\x00\x01\xa1",
    ],
)  # fmt: skip
def test_a_length_past_the_end_of_the_data_is_a_bad_message(data):
    with pytest.raises(BadMessage):
        check_msgpack(b"\x92" + msgspec.msgpack.encode(LONG) + data, WIDE)


def test_bytes_after_a_message_are_a_bad_message():
    with pytest.raises(BadMessage, match="follow"):
        check_msgpack(msgspec.msgpack.encode(LONG) + b"\x01", WIDE)


def test_inflating_refuses_what_is_not_one_stream():
    plain = np.random.default_rng(1).bytes(200_000)
    data = zlib.compress(plain)

    for wrong in (data + b"x", data + bytes(100_000), data[:-1], data[:100_000], data[1:], b"", data + data):
        with pytest.raises(BadMessage):
            inflate_within(wrong, WIDE)
    with pytest.raises(LimitExceeded):
        inflate_within(zlib.compress(np.random.default_rng(1).bytes((1 << 20) + 1)), WIDE)


def test_bytes_that_deflate_well_are_refused_by_their_ratio_behind_others_that_do_not():
    noise = np.random.default_rng(3).bytes(1500)
    for zeros, is_allowed in ((25_000, True), (40_000, False), (1 << 19, False)):
        data = zlib.compress(noise + bytes(zeros), 9)
        assert (len(noise) + zeros <= len(data) * WIDE.inflate_ratio) == is_allowed
        if is_allowed:
            assert inflate_within(data, WIDE) == noise + bytes(zeros)
            continue
        with pytest.raises(LimitExceeded):
            inflate_within(data, WIDE)


def test_bytes_after_a_stream_are_seen_wherever_it_ends():
    noise = np.random.default_rng(4).bytes(70_000)
    first = int(WIDE.free_bytes / WIDE.inflate_ratio)
    ends = {first - 1, first, first + 1, first + 65_535, first + 65_536, first + 65_537}
    streams = [zlib.compress(noise[:size], 0) for base in ends for size in range(base - 40, base)]
    assert ends <= {len(data) for data in streams}

    for data in (each for each in streams if len(each) in ends):
        assert inflate_within(data, WIDE) == zlib.decompress(data)
        for more in (b"x", bytes(100_000)):
            with pytest.raises(BadMessage):
                inflate_within(data + more, WIDE)
