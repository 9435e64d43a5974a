"""What the gateway relies on in picows beyond its documentation; the version is pinned, too."""

from __future__ import annotations

import asyncio
import logging

from picows import picows

from rse_pf.backend.gateway.websocket import PendingSocket, protocol_type


def test_the_protocol_takes_the_fifteen_arguments_that_we_give_it():
    async def make() -> object:
        return protocol_type(picows)(
            PendingSocket("127.0.0.1", 8192), lambda: None, None, None, False, lambda request: None,
            logging.getLogger("t"), True, 5.0, False, 20.0, 20.0, picows.WSAutoPingStrategy.PING_WHEN_IDLE,
            False, 1000, None, 2048,
        )  # fmt: skip

    protocol = asyncio.run(make())

    assert isinstance(protocol, picows.WSProtocol)
    assert protocol.transport is None
    assert len(protocol.get_buffer(-1)) >= 1024


def test_opcodes_are_the_numbers_of_the_rfc():
    names = ("CONTINUATION", "TEXT", "BINARY", "CLOSE", "PING", "PONG")

    assert [int(getattr(picows.WSMsgType, name)) for name in names] == [0, 1, 2, 8, 9, 10]
