"""A `FakeServer` in a thread, for programs that block."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator

from tests.kit.fakes import FakeServer


class ServerThread:
    """A fake server in the event loop of a thread; any thread may `cut` its connections."""

    def __init__(self, server: FakeServer, loop: asyncio.AbstractEventLoop) -> None:
        self.server = server
        self.url = server.url
        self._loop = loop

    def cut(self) -> None:
        """Abort every connection without a close handshake."""
        self._loop.call_soon_threadsafe(self.server.cut)


@contextlib.contextmanager
def server_thread() -> Iterator[ServerThread]:
    """Run a fake server in a thread until the end of the ``with`` block."""
    started = threading.Event()
    stop: list[asyncio.Event] = []
    made: list[ServerThread] = []
    loop = asyncio.new_event_loop()

    async def serve() -> None:
        stop.append(asyncio.Event())
        async with FakeServer().running() as server:
            made.append(ServerThread(server, loop))
            started.set()
            await stop[0].wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    assert started.wait(10)
    yield made[0]
    loop.call_soon_threadsafe(stop[0].set)
    thread.join(10)
    loop.close()
