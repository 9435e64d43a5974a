"""A glance at a command tells whom to refuse, and never more than is there."""

from __future__ import annotations

import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.wire import CODECS, Command, Hello, Ping, make_codec
from rse_pf.wire.envelope import Envelope, peek


@pytest.mark.parametrize("name", CODECS)
@given(identity=st.integers(0, 2**53 - 1), size=st.integers(0, 3000))
def test_id_and_service_are_read_whatever_the_payload(name: str, identity: int, size: int) -> None:
    codec = make_codec(name)
    command = Command(id=identity, service="pnp", payload={"x": list(range(size))}, trace="t", keep=True)

    assert peek(codec, codec.encode(command)) == Envelope(identity, "pnp")


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("message", [Hello(), Ping(sent_s=1.0)])
def test_other_messages_are_left_to_the_codec(name: str, message: object) -> None:
    codec = make_codec(name)

    assert peek(codec, codec.encode(message)) is None


@pytest.mark.parametrize("name", CODECS)
@given(data=st.binary(max_size=300))
def test_invalid_bytes_are_left_to_the_codec(name: str, data: bytes) -> None:
    assert peek(make_codec(name), data) is None


@pytest.mark.parametrize(
    "text",
    [
        b'{"id":1,"type":"command","service":"pnp"}',
        b'{"type":"command","id":-1,"service":"pnp"}',
        b'{"type":"command","id":9007199254740992,"service":"pnp"}',
        b'{"type":"command","id":01,"service":"pnp"}',
        b'{"type":"command","id":1,"service":"a\\u0041"}',
        b'{"type":"command","id":1,"service":"' + b"x" * 65 + b'"}',
        b'{"type":"command","id":1,"service":"pnp',
    ],
)
def test_an_unusual_head_is_left_to_the_codec(text: bytes) -> None:
    assert peek(make_codec("json"), text) is None
    assert peek(make_codec("zlib"), zlib.compress(text)) is None


def test_a_decompression_bomb_is_not_inflated_for_its_envelope() -> None:
    bomb = zlib.compress(b'{"type":"command","id":1,"service":"pnp","payload":"' + b"x" * 10**7)

    assert peek(make_codec("zlib"), bomb) == Envelope(1, "pnp")
