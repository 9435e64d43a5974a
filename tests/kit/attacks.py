"""Attacks of a hostile robot or client on a platform, each bounded in number and time.

The attacks send raw frames without any library of ours, and close every socket.
"""

from __future__ import annotations

import asyncio
import base64
import itertools
import os
import random
import struct
import time
import zlib
from collections import Counter
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass, field
from functools import cache
from urllib.parse import urlsplit

from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Hello, make_codec

CONTINUATION, BINARY, CLOSE, PING, PONG = 0, 2, 8, 9, 10
FIN, MASKED = 0x80, 0x80
LONG_S = 25.0


def frame(payload: bytes, opcode: int = BINARY, *, fin: bool = True) -> bytes:
    """Return one client frame; the mask is zero, which RFC 6455 cannot forbid."""
    size = len(payload)
    if size < 126:
        length = bytes([MASKED | size])
    elif size < 65536:
        length = bytes([MASKED | 126]) + struct.pack(">H", size)
    else:
        length = bytes([MASKED | 127]) + struct.pack(">Q", size)
    return bytes([(FIN if fin else 0) | opcode]) + length + bytes(4) + payload


@dataclass(frozen=True, slots=True)
class AttackTarget:
    """The address and the tokens of an attack."""

    url: str
    tokens: tuple[str, ...] = ()

    async def open_tcp(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Open a TCP connection."""
        parts = urlsplit(self.url)
        return await asyncio.open_connection(parts.hostname, parts.port)

    def head(self, token: str, codec: str, *more: str) -> bytes:
        """Return the head of a handshake."""
        lines = [
            f"GET {urlsplit(self.url).path} HTTP/1.1", "Host: a", "Upgrade: websocket", "Connection: Upgrade",
            "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[codec]}", f"Authorization: Bearer {token}", *more,
        ]  # fmt: skip
        return "\r\n".join(lines).encode() + b"\r\n\r\n"

    async def enter(self, token: str, codec: str = "zlib") -> Socket:
        """Shake hands and say hello; raises ConnectionError with the status line where refused."""
        reader, writer = await self.open_tcp()
        writer.write(self.head(token, codec))
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), LONG_S)
        except asyncio.IncompleteReadError:
            raise ConnectionError("HTTP/1.1 cut") from None
        if not head.startswith(b"HTTP/1.1 101"):
            writer.transport.abort()
            raise ConnectionError(head.split(b"\r\n")[0].decode("latin-1"))
        made = Socket(reader, writer, codec)
        made.say(Hello())
        await made.hear()
        return made


class Socket:
    """A robot's socket after its handshake, which may send whatever it likes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, codec: str) -> None:
        self.codec = make_codec(codec)
        self.reader = reader
        self.writer = writer
        self.closed: int | None = None
        """The close code, 1006 where the connection ended without one."""

    def send(self, data: bytes) -> None:
        """Write raw bytes, unless the connection is over."""
        if not self.writer.transport.is_closing():
            self.writer.write(data)

    def say(self, message: object) -> None:
        """Write one message as it should be."""
        self.send(frame(self.codec.encode(message)))  # type: ignore[arg-type]

    async def hear(self) -> object:
        """Return the next message; None once the socket is closed."""
        while self.closed is None:
            try:
                first, second = await self.reader.readexactly(2)
                size = second & 127
                if size > 125:
                    width = 2 if size == 126 else 8
                    size = int.from_bytes(await self.reader.readexactly(width), "big")
                payload = await self.reader.readexactly(size)
            except (asyncio.IncompleteReadError, OSError):
                self.closed = 1006
                break
            if first & 15 == CLOSE:
                self.closed = int.from_bytes(payload[:2], "big") if payload else 1005
            elif first & 15 not in (PING, PONG):
                return self.codec.decode_from_server(payload)
        return None

    async def drain(self) -> None:
        """Wait until the kernel took what was written; a connection that ended is no error."""
        try:
            await self.writer.drain()
        except OSError:
            return

    def end(self) -> None:
        """Leave without a word."""
        self.writer.transport.abort()


@dataclass(slots=True)
class Outcome:
    """What came of an attack: things tried, things refused, how sockets ended, seconds from begin to end."""

    tried: int = 0
    refused: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    took_s: float = 0.0


@cache
def bomb() -> bytes:
    """Return a message of 255 KB that would inflate to 256 MiB; it takes a second to make."""
    packer = zlib.compressobj(9)
    made = b"".join(packer.compress(bytes(1 << 20)) for _ in range(256)) + packer.flush()
    return made[:262144]


async def zip_bombs(target: AttackTarget, count: int = 1000, pause_s: float = 1.0) -> Outcome:
    """Send *count* messages of 255 KB that would inflate to 256 MiB, ten a robot, all robots at once.

    Who is thrown out comes back at once, and after *pause_s* if the target stays shut; each try counts.
    """
    message, each = frame(bomb()), 10
    outcome = Outcome()

    async def robot(token: str) -> None:
        socket: Socket | None = None
        for _ in range(each):
            began = time.monotonic()
            outcome.tried += 1
            if socket is None:
                try:
                    socket = await target.enter(token)
                except ConnectionError as error:
                    outcome.refused += 1
                    outcome.ends[str(error)[9:12]] += 1
                    await asyncio.sleep(pause_s)
                    continue
            socket.send(message)
            answer = await socket.hear()
            is_refused = isinstance(answer, Failure) and answer.code in ("too-large", "busy")
            outcome.refused += is_refused or socket.closed is not None
            outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - began)
            if socket.closed is not None:
                outcome.ends[str(socket.closed)] += 1
                socket.end()
                socket = None
        if socket is not None:
            outcome.ends[str(socket.closed)] += 1
            socket.end()

    await _all([robot(token) for token in target.tokens[: count // each]])
    return outcome


async def large_documents(target: AttackTarget, documents: Sequence[bytes]) -> Outcome:
    """Send one of the *documents*, each a JSON payload, from every robot at once, deflated.

    A text before it that hardly deflates keeps a message from being a bomb.  The codes of the answers are the
    ends.
    """
    outcome = Outcome(tried=len(target.tokens))
    noise = base64.b64encode(random.Random(1).randbytes(12_000))
    head = b'{"type":"command","id":7,"service":"echo","noise":"' + noise + b'","payload":'
    endless = itertools.cycle([frame(zlib.compress(head + document + b"}", 6)) for document in documents])

    async def send(socket: Socket, message: bytes) -> None:
        socket.send(message)
        answer = await socket.hear()
        outcome.ends[answer.code if isinstance(answer, Failure) else type(answer).__name__] += 1
        socket.end()

    sockets = [await target.enter(token) for token in target.tokens]
    await _all([send(socket, next(endless)) for socket in sockets])
    return outcome


async def empty_fragments(target: AttackTarget, count: int = 200_000) -> Outcome:
    """Begin one message and never end it: *count* empty fragments."""
    socket = await target.enter(target.tokens[0])
    began = frame(b"", fin=False)
    return await _flood(socket, began, frame(b"", CONTINUATION, fin=False), count)


async def ping_flood(target: AttackTarget, count: int = 200_000) -> Outcome:
    """Send *count* ping frames as fast as the connection takes them."""
    socket = await target.enter(target.tokens[0])
    return await _flood(socket, b"", frame(b"x", PING), count)


async def slow_headers(target: AttackTarget, count: int = 400, pause_s: float = 0.5) -> Outcome:
    """Send the head of *count* handshakes one header at a time."""
    outcome = Outcome(tried=count)

    async def one() -> None:
        reader, writer = await target.open_tcp()
        began = time.monotonic()
        ending = asyncio.create_task(reader.read(4096))
        writer.write(b"GET / HTTP/1.1\r\nHost: a\r\n")
        while not ending.done() and time.monotonic() - began < LONG_S:
            await asyncio.wait({ending}, timeout=pause_s)
            if not ending.done() and not writer.transport.is_closing():
                writer.write(b"X-A: b\r\n")
        await _count_end(outcome, writer, ending, began)

    await _all([one() for _ in range(count)])
    return outcome


async def silent_connects(target: AttackTarget, count: int = 2000) -> Outcome:
    """Open *count* connections and say nothing."""
    outcome = Outcome(tried=count)

    async def one() -> None:
        reader, writer = await target.open_tcp()
        began = time.monotonic()
        ending = asyncio.create_task(reader.read(4096))
        await asyncio.wait({ending}, timeout=LONG_S)
        await _count_end(outcome, writer, ending, began)

    await _all([one() for _ in range(count)])
    return outcome


async def rate_flood(target: AttackTarget, per_s: float = 500.0, seconds: float = 10.0) -> Outcome:
    """Be one robot that sends *per_s* commands a second, and comes back whenever it is cut off."""
    outcome, until = Outcome(), time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            socket = await target.enter(target.tokens[0], "bin")
        except ConnectionError as error:
            outcome.ends[str(error)[9:12]] += 1
            await asyncio.sleep(0.1)  # thrown out, it comes back at this pace
            continue
        hearing = asyncio.create_task(_hear_all(socket, outcome))
        command = frame(socket.codec.encode(Command(id=1, service="echo", payload={"value": 1}, keep=True)))
        began, sent = time.monotonic(), 0
        while time.monotonic() < until and not hearing.done():
            wanted = int((time.monotonic() - began) * per_s)
            socket.send(command * (wanted - sent))
            outcome.tried += wanted - sent
            sent = wanted
            await asyncio.wait({hearing}, timeout=0.005)
        hearing.cancel()
        await asyncio.wait({hearing})
        outcome.ends[str(socket.closed)] += 1
        socket.end()
    return outcome


async def _hear_all(socket: Socket, outcome: Outcome) -> None:
    while (answer := await socket.hear()) is not None:
        outcome.refused += isinstance(answer, Failure) and answer.code == "busy"


async def _flood(socket: Socket, first: bytes, each: bytes, count: int) -> Outcome:
    outcome, began = Outcome(), time.monotonic()
    hearing = asyncio.create_task(socket.hear())
    socket.send(first)
    while outcome.tried < count and not hearing.done() and time.monotonic() - began < LONG_S:
        socket.send(each * 1000)
        outcome.tried += 1000
        await asyncio.wait(
            {hearing, asyncio.create_task(socket.drain())}, return_when=asyncio.FIRST_COMPLETED
        )
    await asyncio.wait({hearing}, timeout=LONG_S)
    outcome.refused = int(socket.closed is not None)
    outcome.ends[str(socket.closed)] += 1
    outcome.slowest_s = time.monotonic() - began
    socket.end()
    hearing.cancel()
    return outcome


async def _count_end(
    outcome: Outcome, writer: asyncio.StreamWriter, ending: asyncio.Task[bytes], began: float
) -> None:
    if ending.done():
        answer = b"" if ending.exception() is not None else ending.result()
        outcome.refused += 1
        outcome.ends[answer[9:12].decode("latin-1") or "cut"] += 1
        outcome.slowest_s = max(outcome.slowest_s, time.monotonic() - began)
    else:
        ending.cancel()
        outcome.ends["open"] += 1
    writer.transport.abort()


async def _all(works: list[Awaitable[None]]) -> None:
    for result in await asyncio.gather(*works, return_exceptions=True):
        if isinstance(result, BaseException) and not isinstance(result, OSError):
            raise result
