"""A network between a client and the platform: it is cut, cuts messages into fragments, or reads slowly."""

from __future__ import annotations

import asyncio
import contextlib
import socket

__all__ = ["Fragments", "Link"]

_HEAD_END = b"\r\n\r\n"
_CONTINUES, _FIN, _MASKED, _OPCODE = 0x00, 0x80, 0x80, 0x0F
_FIRST_CONTROL = 0x8
_READ_BYTES = 65536
_TICK_S = 0.05


class Fragments:
    """Cuts each message of a WebSocket into fragments of at most *max_bytes*, a multiple of four.

    The four bytes of a mask then begin anew with each fragment, so that it stays what it was.

    Source:
        RFC 6455, 5.2 and 5.4.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._held = b""
        self._is_head = True
        self.made = 0

    def feed(self, data: bytes) -> bytes:
        """Return what to send for *data*; the beginning of a frame waits for its end."""
        self._held += data
        sent = b""
        if self._is_head:
            end = self._held.find(_HEAD_END)
            if end < 0:
                return b""
            sent, self._held = self._held[: end + 4], self._held[end + 4 :]
            self._is_head = False
        while (frame := self._next()) is not None:
            sent += frame
        return sent

    def _next(self) -> bytes | None:
        """Take the next whole frame; return it in fragments."""
        held = self._held
        if len(held) < 2:
            return None
        first, second = held[0], held[1]
        length, at = second & 0x7F, 2
        if length >= 126:
            at = 4 if length == 126 else 10
            length = int.from_bytes(held[2:at], "big")
        mask = held[at : at + 4] if second & _MASKED else b""
        at += 4 if second & _MASKED else 0
        if len(held) < at + length:
            return None
        payload, self._held = held[at : at + length], held[at + length :]
        if first & _OPCODE >= _FIRST_CONTROL or length <= self._max_bytes:
            return held[: at + length]
        pieces = [payload[i : i + self._max_bytes] for i in range(0, length, self._max_bytes)]
        self.made += len(pieces)
        made = b""
        for number, piece in enumerate(pieces):
            opcode = first & 0x7F if number == 0 else _CONTINUES
            is_last = number == len(pieces) - 1
            made += _frame(opcode | (first & _FIN if is_last else 0), piece, mask)
        return made


def _frame(first: int, masked_payload: bytes, mask: bytes) -> bytes:
    size, bit = len(masked_payload), _MASKED if mask else 0
    if size < 126:
        head = bytes([first, bit | size])
    elif size < 1 << 16:
        head = bytes([first, bit | 126]) + size.to_bytes(2, "big")
    else:
        head = bytes([first, bit | 127]) + size.to_bytes(8, "big")
    return head + mask + masked_payload


class Link:
    """A TCP proxy on loopback to one address; ``async with Link(port) as link``."""

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._flows = asyncio.Event()
        self._flows.set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.port = 0
        self.connections = 0
        self.fragment_bytes: tuple[int, int] | None = None
        self.fragments = 0
        self.down_bytes_per_s: float | None = None

    async def __aenter__(self) -> Link:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def cut(self, seconds: float) -> None:
        """Carry nothing for so long; then what waited arrives, as with TCP over a radio."""
        self._flows.clear()
        await asyncio.sleep(seconds)
        self._flows.set()

    def drop(self) -> None:
        """End every connection, as a load balancer that dies does."""
        for task in list(self._tasks):
            task.cancel()

    async def away(self, seconds: float) -> None:
        """End every connection, and refuse each new one for so long."""
        self._server.close()
        self.drop()
        await asyncio.sleep(seconds)
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        with contextlib.suppress(OSError, asyncio.CancelledError):
            await self._carry(reader, writer)
        writer.transport.abort()
        self._tasks.discard(task)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._flows.wait()
        there, back = await asyncio.open_connection("127.0.0.1", self._target_port)
        if self.down_bytes_per_s is not None:
            back.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        up, down = self.fragment_bytes or (0, 0)
        pumps = [
            asyncio.ensure_future(self._pump(reader, back, Fragments(up) if up else None, is_down=False)),
            asyncio.ensure_future(self._pump(there, writer, Fragments(down) if down else None, is_down=True)),
        ]
        try:
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in pumps:
                each.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)
            with contextlib.suppress(OSError):
                await asyncio.wait_for(writer.drain(), 1.0)
            for each in (back, writer):
                each.close()

    async def _pump(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        fragments: Fragments | None,
        *,
        is_down: bool,
    ) -> None:
        while True:
            rate = self.down_bytes_per_s if is_down else None
            if rate is not None:
                await asyncio.sleep(_TICK_S)
            data = await reader.read(_READ_BYTES if rate is None else max(1, int(rate * _TICK_S)))
            if not data:
                return
            await self._flows.wait()
            if fragments is not None:
                before = fragments.made
                data = fragments.feed(data)
                self.fragments += fragments.made - before
            writer.write(data)
            await writer.drain()
