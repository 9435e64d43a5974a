"""A fake burst function behind a fake load balancer, by HTTP in the event loop of the test.

It answers as `lambda_pnp` does; ``status`` and ``hold`` make it fail or stay silent.
"""

from __future__ import annotations

import asyncio
import time

from rse_pf.config import PlatformSettings
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, make_codec

__all__ = ["FakeBurst"]


class FakeBurst:
    """One function; ``commands`` are those that it got, ``headers`` what came with them."""

    def __init__(self) -> None:
        self.commands: list[Command] = []
        self.headers: list[dict[str, str]] = []
        self.connections = 0
        self.status = 200
        self.content_type = ""
        self.failure: Failure | None = None
        self.hold = False
        self.closes = False
        self._registry = builtin_services(PlatformSettings())
        self._writers: list[asyncio.StreamWriter] = []

    async def __aenter__(self) -> FakeBurst:
        """Listen."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop."""
        self.cut()
        self._server.close()
        await self._server.wait_closed()

    @property
    def url(self) -> str:
        """Where commands are posted."""
        return f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/burst"

    def cut(self) -> None:
        """End every connection, as a load balancer does with an idle one."""
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.append(writer)
        try:
            while await self._answer(reader, writer):
                pass
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.transport.abort()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        first, *lines = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        assert first == "POST /burst HTTP/1.1"
        headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines if line)}
        body = await reader.readexactly(int(headers["content-length"]))
        names = {f"application/{wire}": name for name, wire in SUBPROTOCOLS.items()}
        codec = make_codec(names[headers["content-type"]])
        command = codec.decode_from_robot(body)
        assert isinstance(command, Command)
        self.commands.append(command)
        self.headers.append(headers)
        if self.hold:
            await asyncio.Event().wait()
        answer = self.failure or dispatch(self._registry, command, time.monotonic, server="lambda")
        data = codec.encode(answer)
        kind = self.content_type or headers["content-type"]
        head = f"HTTP/1.1 {self.status} X\r\nContent-Type: {kind}\r\nContent-Length: {len(data)}\r\n\r\n"
        writer.write(head.encode() + data)
        await writer.drain()
        return not self.closes
