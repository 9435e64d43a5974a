"""A message that inflates without end is refused before it weighs much."""

from __future__ import annotations

import tracemalloc
import zlib

import pytest

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded
from rse_pf.wire import Command
from rse_pf.wire.server_codec import make_server_codec

LIMITS = SessionSettings()


def bomb(inflated: int, content: bytes = b"0") -> bytes:
    packer = zlib.compressobj(9)
    pieces = [packer.compress(content * (1 << 20)) for _ in range(inflated >> 20)]
    return b"".join(pieces) + packer.flush()


def test_a_bomb_costs_no_more_memory_than_a_message_may_have():
    codec, data = make_server_codec("zlib"), bomb(256 << 20)[: LIMITS.max_message_bytes]
    assert len(data) > 250_000
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceeded):
            codec.decode_from_robot(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert peak < 2 * LIMITS.max_message_bytes + 100_000


@pytest.mark.parametrize("size", [1000, 2600, 2622, 20_000, 200_000, 262_000])
def test_a_text_of_an_allowed_size_is_accepted_at_any_ratio(size):
    codec = make_server_codec("zlib")
    message = Command(id=1, service="echo", payload=["x" * (size - 80)])

    assert codec.decode_from_robot(codec.encode(message)) == message


def test_more_than_all_that_is_allowed_is_refused_where_it_grows_slowly():
    codec = make_server_codec("zlib")
    text = b",".join(b"%d" % (k * 2654435761 % 2**32) for k in range(130_000))
    data = zlib.compress(text, 9)[: LIMITS.max_message_bytes]

    with pytest.raises((LimitExceeded, BadMessage)):
        codec.decode_from_robot(data)
