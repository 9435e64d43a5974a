"""A TCP relay on loopback whose delay changes while connections are open, and which can die or stall."""

from __future__ import annotations

import asyncio
from collections import deque


class DelayingProxy:
    """Relays to *port* of loopback; use it with ``async with``.

    ``delay_s`` is one way.  A connection costs one round trip before its first byte passes, as its SYN would.
    """

    def __init__(self, port: int, delay_s: float) -> None:
        self.delay_s = delay_s
        self.is_stalled = False
        self.accepted = 0
        self.target = port
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._writers: set[asyncio.StreamWriter] = set()
        self.port = 0

    @property
    def url(self) -> str:
        """Address of the relay, to which a robot connects."""
        return f"ws://127.0.0.1:{self.port}/ws"

    async def __aenter__(self) -> DelayingProxy:
        """Listen on a free port."""
        await self.listen()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Reset all connections and stop listening."""
        await self.die()

    async def listen(self) -> None:
        """Listen, at the earlier port if there was one."""
        self._server = await asyncio.start_server(self._relay, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def die(self) -> None:
        """Reset every connection and listen no longer."""
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in list(self._writers):
            writer.transport.abort()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._writers.add(writer)
        self.accepted += 1
        there: asyncio.StreamWriter | None = None
        try:
            await asyncio.sleep(2 * self.delay_s)  # the handshake of TCP takes a round trip
            back, there = await asyncio.open_connection("127.0.0.1", self.target)
            self._writers.add(there)
            await asyncio.gather(self._pump(reader, there), self._pump(back, writer))
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            self._tasks.discard(task)
            for stream in (writer, there):
                if stream is not None:
                    self._writers.discard(stream)
                    stream.transport.abort()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Carry bytes one way; each piece arrives after the delay, and never before an earlier one."""
        loop = asyncio.get_running_loop()
        held: deque[tuple[float, bytes]] = deque()
        more = asyncio.Event()

        async def deliver() -> None:
            while True:
                while not held:
                    more.clear()
                    await more.wait()
                due, data = held.popleft()
                await asyncio.sleep(due - loop.time())
                if not data:
                    writer.transport.abort()
                    return
                if not self.is_stalled:
                    writer.write(data)

        delivery = loop.create_task(deliver())
        try:
            data = b"-"
            while data:
                data = await reader.read(65536)
                held.append((loop.time() + self.delay_s, data))
                more.set()
            await delivery
        finally:
            delivery.cancel()
