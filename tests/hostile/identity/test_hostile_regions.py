"""Regions that are hostile or broken: where a token goes, and what the robot does meanwhile."""

from __future__ import annotations

import asyncio
import random
import ssl
import subprocess
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import SessionSettings
from rse_pf.errors import ConnectError, RsePfError
from tests.kit.fake_platform import FakePlatform

pytestmark = pytest.mark.system

QUICK = SessionSettings(
    stall_timeout_s=0.6, ping_interval_s=0.1, ping_timeout_s=0.8,
)  # fmt: skip
TIMINGS = ConnectTimings(
    connect_timeout_s=1.0, reconnect_max_s=0.05, reconnect_long_max_s=0.2, region_hold_s=0.5
)
TOKEN = "a-token-of-this-robot"
Answer = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Region:
    """A server of a stranger: it answers every connection with *answer*, and keeps what it was told."""

    def __init__(self, answer: Answer) -> None:
        self.heard: list[bytes] = []
        self._answer = answer

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            self.heard.append(await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 5))
            await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.TimeoutError):
            pass
        finally:
            writer.close()


@asynccontextmanager
async def region(answer: Answer, **options: Any) -> Any:
    made = Region(answer)
    server = await asyncio.start_server(made.serve, "127.0.0.1", 0, **options)
    scheme = "wss" if options.get("ssl") else "ws"
    made.url = f"{scheme}://127.0.0.1:{server.sockets[0].getsockname()[1]}/ws"  # type: ignore[attr-defined]
    try:
        yield made
    finally:
        server.close()


def says(head: str, body: bytes = b"") -> Answer:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(f"HTTP/1.1 {head}\r\ncontent-length: {len(body)}\r\n\r\n".encode() + body)
        await writer.drain()

    return answer


def robot(*urls: str, **options: Any) -> Any:
    return client_sdk.connect(
        list(urls),
        token=TOKEN,
        settings=QUICK,
        timings=options.pop("timings", TIMINGS),
        random=random.Random(1),
        **options,
    )


@pytest.mark.parametrize("status", ["301 Moved Permanently", "302 Found", "307 Temporary", "308 Permanent"])
async def test_a_token_follows_no_redirect(status: str) -> None:
    async with region(says("200 OK")) as thief:
        where = thief.url
        async with region(says(f"{status}\r\nlocation: {where}")) as listed:
            with pytest.raises(RsePfError) as raised:
                async with robot(listed.url):
                    pass
            listed, stolen, error = listed.heard, thief.heard, raised.value
    assert any(TOKEN.encode() in each for each in listed)
    assert stolen == []
    assert status[:3] in error.message
    assert error.hint


async def test_a_region_that_redirects_does_not_keep_a_robot_from_the_other_one() -> None:
    async with AsyncExitStack() as stack:
        honest = await stack.enter_async_context(FakePlatform())
        thief = await stack.enter_async_context(region(says("200 OK")))
        hostile = await stack.enter_async_context(region(says(f"302 Found\r\nlocation: {thief.url}")))
        async with robot(hostile.url, honest.url) as one:
            answer = await one.call("echo", {"value": 1}, deadline_s=10)
        server, stolen = answer.server, thief.heard
    assert server
    assert stolen == []


HOSTILE: dict[str, Answer] = {
    "refuses at once, for a year": says("503 Busy\r\nretry-after: 31536000"),
    "refuses, for a time of nonsense": says("503 Busy\r\nretry-after: " + "9" * 400),
    "says that the token is wrong, in its own words": says("401 Unauthorized", b"go away"),
    "says that the robot is forbidden": says("403 Forbidden", b"<html>login</html>"),
    "claims an upgrade that it does not speak": says("101 Switching Protocols\r\nupgrade: websocket"),
    "answers without end": says("200 OK\r\n" + "x-filler: y\r\n" * 2000),
    "answers nothing": lambda reader, writer: asyncio.sleep(2),  # type: ignore[dict-item]
    "hangs up": lambda reader, writer: asyncio.sleep(0),  # type: ignore[dict-item]
    "answers garbage": says("\x00\xff garbage"),
}


@pytest.mark.parametrize("what", HOSTILE)
async def test_a_region_that_misbehaves_costs_the_robot_nothing_in_the_other_one(what: str) -> None:
    async with FakePlatform() as honest, region(HOSTILE[what]) as hostile:
        begin = asyncio.get_running_loop().time()
        async with robot(hostile.url, honest.url) as one:
            connected_s = asyncio.get_running_loop().time() - begin
            for number in range(20):
                assert (await one.call("echo", {"value": number}, deadline_s=5)).reply == {"value": number}
        dialled = len(hostile.heard)
    assert connected_s < 5.0
    assert dialled < 200


async def test_a_region_that_accepts_and_hangs_up_in_turn_is_left_and_no_command_is_lost() -> None:
    """A flapping region: it may be the nearest one each time, and loses every connection."""

    async with FakePlatform() as honest, FakePlatform() as flapping:
        honest.landing, flapping.landing = "honest", "flapping"
        servers = []
        async with robot(flapping.url, honest.url) as one:
            for number in range(40):
                answer = await one.call("echo", {"value": number}, deadline_s=10)
                servers.append(answer.server)
                if number % 4 == 0:
                    for each in flapping.open_sockets():
                        each.cut()
            failed = one.stats.failed
    assert len(servers) == 40
    assert failed == 0
    assert "honest" in servers


async def test_a_token_goes_to_no_region_whose_certificate_is_not_trusted(tmp_path: Path) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    command += ["-subj", "/CN=127.0.0.1", "-days", "1", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)

    async with region(says("200 OK"), ssl=context) as hostile:
        with pytest.raises(ConnectError) as raised:
            async with robot(hostile.url, timings=replace(TIMINGS, connect_timeout_s=0.5)):
                pass
        heard, error = hostile.heard, raised.value
    assert heard == [], "no byte of the request was sent"
    assert "does not trust" in error.message
