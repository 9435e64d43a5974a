"""A subscriber that reads more slowly than its publisher sends gets the newest messages, and stays."""

from __future__ import annotations

import asyncio
import socket
from urllib.parse import urlsplit

import pytest
from rosbridge.conftest import opened

from tests.kit.guarded_server import GuardedServer
from tests.kit.rosbridge_clients import Client, publish, subscribe

pytestmark = pytest.mark.slow
SECONDS = 15.0
READ_EVERY_S, SENT_EVERY_S = 0.5, 0.1
MAX_AGE_S = 2.5
"""On a busy machine; without the acknowledgements it is 10 s after `SECONDS`, and grows on."""


@pytest.mark.parametrize("size_bytes", [2_000, 100_000])
async def test_what_a_slow_subscriber_reads_is_never_old(server: GuardedServer, size_bytes: int) -> None:
    async with opened(server) as bridge:
        clock = asyncio.get_running_loop().time
        raw = socket.socket()
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
        raw.connect((urlsplit(bridge.url).hostname, urlsplit(bridge.url).port))
        raw.setblocking(False)
        talker = await bridge.client()
        slow = await bridge.open(server.token("slow"), sock=raw, max_queue=1, ping_interval=None)
        await slow.send(subscribe(queue_length=1))
        await slow.settle()
        ends_s = clock() + SECONDS
        sending = asyncio.create_task(_publish(talker, size_bytes, ends_s))
        ages = []
        while clock() < ends_s:
            (data,) = await slow.data()
            ages.append(clock() - float(data.split()[0]))
            await asyncio.sleep(READ_EVERY_S)  # it is the reader that is slow
        await sending

        assert max(ages) < MAX_AGE_S
        assert (await slow.ask(publish("x")))["op"] == "publish", "the connection stays"


async def _publish(talker: Client, size_bytes: int, ends_s: float) -> None:
    clock = asyncio.get_running_loop().time
    while clock() < ends_s:
        await talker.send(publish(f"{clock()} " + "x" * size_bytes))
        await asyncio.sleep(SENT_EVERY_S)
