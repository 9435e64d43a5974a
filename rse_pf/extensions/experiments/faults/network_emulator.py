"""A network link in user space: delay, jitter, a rate and cuts between robots and a server, without root.

`EmulatedLink` relays TCP connections on loopback; `LinkProcess` runs one in a process of its own, so that a
busy robot does not add to the delay.  Bytes keep their order and none is lost.  A cut closes no socket: bytes
that are sent during a cut arrive after it, at the time at which TCP would have retransmitted them.  New
connections are not accepted during a cut, because the queue of the listening socket is kept full.
"""

from __future__ import annotations

import asyncio
import math
import multiprocessing
import random
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from rse_pf.errors import ConfigurationError, UsageError

__all__ = [
    "PROFILES",
    "EmulatedLink",
    "Lane",
    "LinkProcess",
    "LinkProfile",
    "profile_named",
    "retransmitted_s",
]

# Address at which an emulated link listens.
_LOOPBACK = "127.0.0.1"
# Shortest delay of a link with jitter, in seconds, unless its nominal delay is shorter.
_MIN_DELAY_S = 0.001
# A direction of a connection reads no more from its source while it holds more than this many undelivered
# bytes.
_MAX_UNDELIVERED_BYTES = 1 << 20
# Length of the queue of connections that wait to be accepted.
_BACKLOG = 1024
# Number of connections that the link opens to itself during a cut: one fills the listener's queue of length
# one, the other is spare.
_FILLING_CONNECTIONS = 2
# Time until TCP on Linux retransmits a lost segment, in seconds; it doubles with each further retransmission.
_FIRST_RETRY_S = 0.2
# Time until TCP on Linux retransmits the first segment of a connection (SYN), in seconds; it doubles as well.
_FIRST_DIAL_RETRY_S = 1.0
# Longest time between two retransmissions, in seconds.
_MAX_RETRY_S = 120.0
# Longest wait for an answer of the process of a link, in seconds; starting the process is the slowest case.
_START_TIMEOUT_S = 20.0
# Time, in seconds, by which timers are set earlier: timers of asyncio fire up to 1 ms late, and the mean
# error then is 0.
_TIMER_GRAIN_S = 0.0005


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkProfile:
    """The delay, jitter, rate and cuts of an emulated link.

    Delays and rates apply to each connection on its own, as if every robot had its own radio; a cut applies
    to all connections.  ``up`` is from a robot to the server, ``down`` from the server to a robot.  Delays
    are one way; ``jitter_s`` is the half width of a uniform distribution around them.  A rate of None has no
    limit.  Cuts begin after random times with the mean ``cut_every_s``, None for never, and last
    ``cut_for_s`` on average.
    """

    name: str
    up_s: float
    down_s: float
    jitter_s: float = 0.0
    up_mbit_per_s: float | None = None
    down_mbit_per_s: float | None = None
    cut_every_s: float | None = None
    cut_for_s: float = 0.0

    @property
    def round_trip_s(self) -> float:
        """The nominal delay from a robot to the server and back, without jitter, in seconds."""
        return self.up_s + self.down_s


# The link profiles by name.
PROFILES = {
    "none": LinkProfile(name="none", up_s=0.0, down_s=0.0),
    # RSE-PF paper, Sect. 6.1, Shenzhen to Seoul: the mean round trip minus the compute time is near 130 ms.
    "paper": LinkProfile(name="paper", up_s=0.065, down_s=0.065),
    "wifi-bad": LinkProfile(
        name="wifi-bad", up_s=0.015, down_s=0.015, jitter_s=0.025, up_mbit_per_s=5.0, down_mbit_per_s=5.0,
        cut_every_s=10.0, cut_for_s=0.3,
    ),
    "lte": LinkProfile(
        name="lte", up_s=0.035, down_s=0.035, jitter_s=0.015, up_mbit_per_s=10.0, down_mbit_per_s=30.0
    ),
}  # fmt: skip


def profile_named(name: str) -> LinkProfile:
    """Return the profile called *name*; raises UsageError if there is none."""
    if name not in PROFILES:
        raise UsageError(f"no link named {name!r}", hint=f"choose one of {', '.join(PROFILES)}")
    return PROFILES[name]


def retransmitted_s(sent_s: float, healed_s: float, first_s: float = _FIRST_RETRY_S) -> float:
    """Return the time of the first retransmission at or after *healed_s* of a segment first sent at *sent_s*.

    Retransmissions before *healed_s* are lost.  *first_s* is the time until the first retransmission.  All
    times are in seconds.

    Source:
        RFC 6298: the time-out doubles with every retransmission; Linux begins with 0.2 s, or 1 s for a SYN.
    """
    pause_s, at_s = first_s, sent_s
    while at_s < healed_s:
        at_s += pause_s
        pause_s = min(_MAX_RETRY_S, 2.0 * pause_s)
    return at_s


class Lane:
    """Arrival times of the bytes in one direction of one connection.

    The class computes times only: it reads no clock and moves no bytes.
    """

    def __init__(
        self, *, delay_s: float, jitter_s: float, mbit_per_s: float | None, random: random.Random
    ) -> None:
        self._delay_s = delay_s
        self._jitter_s = jitter_s
        self._bytes_per_s = None if mbit_per_s is None else mbit_per_s * 125_000.0
        self._random = random
        self._sent_s = 0.0
        self._last_s = 0.0

    def arrival_s(self, now_s: float, size: int) -> float:
        """Return the time at which *size* bytes sent at *now_s* arrive, never before earlier bytes."""
        self._sent_s = max(self._sent_s, now_s)
        if self._bytes_per_s is not None:
            self._sent_s += size / self._bytes_per_s
        late_s = self._random.uniform(-self._jitter_s, self._jitter_s) if self._jitter_s else 0.0
        delay_s = max(min(self._delay_s, _MIN_DELAY_S), self._delay_s + late_s)
        self._last_s = max(self._last_s, self._sent_s + delay_s)
        return self._last_s


class EmulatedLink:
    """A TCP relay from a free port of loopback to a server, with the delays of *profile*.

    Use it with ``async with``; ``port`` is the port to connect to.
    """

    def __init__(self, profile: LinkProfile, target_host: str, target_port: int, *, seed: int = 0) -> None:
        self.profile = profile
        self.port = 0
        self.is_cut = False
        self.cuts = 0
        self.ways: set[_Way] = set()
        self._target = (target_host, target_port)
        self._seed = seed
        self._accepted = 0
        self._cutting: set[str] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._listener: socket.socket | None = None
        self._fillers: dict[Any, socket.socket] = {}

    async def __aenter__(self) -> EmulatedLink:
        """Listen on a free port of loopback, and begin the cuts of the profile."""
        self.loop = asyncio.get_running_loop()
        self._listener = socket.create_server((_LOOPBACK, 0), backlog=_BACKLOG)
        self._listener.setblocking(False)
        self.port = self._listener.getsockname()[1]
        self.loop.add_reader(self._listener, self._accept)
        if self.profile.cut_every_s is not None:
            self._tasks.add(self.loop.create_task(self._cut_periodically(self.profile.cut_every_s)))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop listening and close every connection."""
        assert self._listener is not None
        self.loop.remove_reader(self._listener)
        self._listener.close()
        for filler in self._fillers.values():
            filler.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for way in list(self.ways):
            way.end()
        await asyncio.sleep(0)

    def cut(self, cause: str = "asked") -> None:
        """Deliver nothing in either direction from now on, without closing a connection.

        Bytes that are sent during the cut are kept and delivered after it; new connections are not accepted.
        The cut lasts until `heal` was called for each *cause* of it.
        """
        self._cutting.add(cause)
        if not self.is_cut:
            self.cuts += 1
            self.is_cut = True
            self._stop_answering()

    def heal(self, cause: str = "asked") -> None:
        """End the cut of *cause*; do nothing if there is none.

        Unless another cause remains, new connections are accepted, and the bytes sent meanwhile are delivered
        when TCP would have retransmitted them, see `retransmitted_s`.
        """
        self._cutting.discard(cause)
        if self._cutting or not self.is_cut:
            return
        self.is_cut = False
        self._answer_again()
        for way in list(self.ways):
            way.retry(self.loop.time())

    def _accept(self) -> None:
        assert self._listener is not None
        while True:
            try:
                connection, address = self._listener.accept()
            except OSError:  # no connection waits, or the robot has closed its connection already
                return
            filler = self._fillers.pop(address, None)
            if filler is not None:
                filler.close()
                connection.close()
                continue
            connection.setblocking(False)
            task = self.loop.create_task(self._serve(connection))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        await self.loop.connect_accepted_socket(lambda: _RobotEnd(self), connection)

    def _stop_answering(self) -> None:
        """Let Linux drop the SYN of each new connection, by filling the queue of the listening socket."""
        assert self._listener is not None
        self._accept()
        self.loop.remove_reader(self._listener)
        self._listener.listen(0)
        for _ in range(_FILLING_CONNECTIONS):
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex((_LOOPBACK, self.port))
            self._fillers[filler.getsockname()] = filler

    def _answer_again(self) -> None:
        assert self._listener is not None
        self._listener.listen(_BACKLOG)
        self._accept()
        for filler in self._fillers.values():
            filler.close()
        self._fillers.clear()
        self.loop.add_reader(self._listener, self._accept)

    def lanes(self) -> tuple[Lane, Lane]:
        """Return the two directions of a new connection: from the robot to the server, and back."""
        self._accepted += 1
        p, source = self.profile, random.Random(f"{self._seed}/{self._accepted}")
        up = Lane(delay_s=p.up_s, jitter_s=p.jitter_s, mbit_per_s=p.up_mbit_per_s, random=source)
        down = Lane(delay_s=p.down_s, jitter_s=p.jitter_s, mbit_per_s=p.down_mbit_per_s, random=source)
        return up, down

    def dial(self, make: Callable[[], asyncio.Protocol], failed: Callable[[], None]) -> None:
        """Open a connection to the server with the protocol of *make*.

        Call *failed* if that is not possible.
        """

        async def work() -> None:
            try:
                await self.loop.create_connection(make, *self._target)
            except OSError:
                failed()

        task = self.loop.create_task(work())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def at(self, when_s: float, act: Callable[..., None], *arguments: Any) -> None:
        """Call *act* with *arguments* at *when_s*, a time of the event loop's clock."""
        self.loop.call_at(when_s - _TIMER_GRAIN_S, act, *arguments)

    async def _cut_periodically(self, every_s: float) -> None:
        source = random.Random(f"{self._seed}/cuts")
        while True:
            await asyncio.sleep(source.expovariate(1.0 / every_s))
            self.cut("profile")
            await asyncio.sleep(source.expovariate(1.0 / self.profile.cut_for_s))
            self.heal("profile")


class _Way:
    """The bytes on their way in one direction of a connection, from the socket ``source`` to ``sink``.

    An entry of None in the queue stands for the end of the stream.
    """

    def __init__(self, link: EmulatedLink, lane: Lane) -> None:
        self.source: asyncio.Transport | None = None
        self.sink: asyncio.Transport | None = None
        self._link = link
        self._lane = lane
        self._opens_s: float | None = None
        self._queue: deque[tuple[float, float, bytes | None]] = deque()
        self._held = 0
        self._armed_s: float | None = None
        link.ways.add(self)

    def send(self, data: bytes | None) -> None:
        """Queue *data* from the source, None for its end.

        Pause the source while more than 1 MiB are queued.
        """
        now = self._link.loop.time()
        size = len(data) if data is not None else 0
        due = math.inf if self._opens_s is None else self._lane.arrival_s(max(now, self._opens_s), size)
        self._queue.append((due, now, data))
        self._held += size
        if self._held > _MAX_UNDELIVERED_BYTES and self.source is not None and self.source.is_reading():
            self.source.pause_reading()
        self._arm()

    def attach(self, sink: asyncio.Transport) -> None:
        """Set the socket to which the bytes are delivered."""
        self.sink = sink
        self._arm()

    def open(self, when_s: float) -> None:
        """Let bytes be sent from *when_s* on, the end of the emulated TCP handshake."""
        self._opens_s = when_s
        self._queue = deque(
            (self._lane.arrival_s(when_s, len(data or b"")), when_s, data) for _, _, data in self._queue
        )
        self._arm()

    def retry(self, healed_s: float) -> None:
        """After a cut, delay the queued bytes until TCP would have retransmitted the oldest of them."""
        if not self._queue or self._opens_s is None:
            return
        first = retransmitted_s(self._queue[0][1], healed_s)
        again = self._lane.arrival_s(first, 0)
        self._queue = deque((max(due, again), sent, data) for due, sent, data in self._queue)
        # A timer that was set earlier compares its time with the new one, and does nothing.
        self._armed_s = None
        self._arm()

    def end(self) -> None:
        """Drop the queued bytes and close both sockets at once."""
        self._link.ways.discard(self)
        self._queue.clear()
        for transport in (self.source, self.sink):
            if transport is not None:
                transport.abort()

    def _arm(self) -> None:
        is_ready = self.sink is not None and self._opens_s is not None and not self._link.is_cut
        if self._queue and is_ready and self._armed_s is None:
            self._armed_s = self._queue[0][0]
            self._link.at(self._armed_s, self._deliver, self._armed_s)

    def _deliver(self, armed_s: float) -> None:
        if armed_s != self._armed_s:
            return
        self._armed_s = None
        if self._link.is_cut or self.sink is None:
            return
        until = self._link.loop.time() + _TIMER_GRAIN_S
        while self._queue and self._queue[0][0] <= until:
            data = self._queue.popleft()[2]
            if data is None:
                self._link.ways.discard(self)
                self.sink.close()
                return
            self._held -= len(data)
            if not self.sink.is_closing():
                self.sink.write(data)
        if (
            self._held <= _MAX_UNDELIVERED_BYTES // 2
            and self.source is not None
            and not self.source.is_closing()
        ):
            self.source.resume_reading()  # has no effect if reading is not paused
        self._arm()


class _End(asyncio.Protocol):
    """One of the two sockets of a relayed connection: it feeds ``out`` and gets the bytes of ``back``."""

    out: _Way
    back: _Way

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.out.source = transport
        self.back.attach(transport)

    def data_received(self, data: bytes) -> None:
        self.out.send(data)

    def connection_lost(self, error: Exception | None) -> None:
        self.out.send(None)


class _ServerEnd(_End):
    def __init__(self, up: _Way, down: _Way) -> None:
        self.out, self.back = down, up


class _RobotEnd(_End):
    """The socket to a robot: the server is connected once the robot's SYN would have arrived there."""

    def __init__(self, link: EmulatedLink) -> None:
        self._link = link

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        link = self._link
        up, down = link.lanes()
        now = link.loop.time()
        self.out, self.back = _Way(link, up), _Way(link, down)
        self.back.open(now)
        super().connection_made(transport)
        link.at(now + link.profile.up_s, self._dial, now)

    def _dial(self, accepted_s: float) -> None:
        """Connect to the server; during a cut, try again when TCP would retransmit the SYN."""
        link = self._link
        if self.out not in link.ways:  # the link is closed
            return
        if link.is_cut:
            again = retransmitted_s(accepted_s, link.loop.time() + _MIN_DELAY_S, _FIRST_DIAL_RETRY_S)
            link.at(again, self._dial, accepted_s)
        elif self.out.source is not None and not self.out.source.is_closing():
            self.out.open(link.loop.time() + link.profile.down_s)
            link.dial(lambda: _ServerEnd(self.out, self.back), self._end_refused)
        else:
            self._end_refused()

    def _end_refused(self) -> None:
        self.back.send(None)
        self._link.ways.discard(self.out)


class LinkProcess:
    """An `EmulatedLink` in a process of its own; use it with ``async with``, then connect to ``port``."""

    def __init__(self, profile: LinkProfile, target_host: str, target_port: int, *, seed: int = 0) -> None:
        self.port = 0
        self._arguments = (profile, target_host, target_port, seed)
        self._process: Any = None
        self._pipe: Connection | None = None

    async def __aenter__(self) -> LinkProcess:
        """Start the process; raises ConfigurationError if it does not report its port within 20 s."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_run, args=(self._arguments, theirs), name="link", daemon=True)
        await asyncio.to_thread(self._process.start)
        theirs.close()
        try:
            self.port = await self._ask(None)
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the pipe, on which the process exits; kill it after 2 s."""
        await self._end()

    async def cut(self) -> None:
        """Begin a cut; return once the process has confirmed it."""
        await self._ask("cut")

    async def heal(self) -> None:
        """End the cut; return once the process has confirmed it."""
        await self._ask("heal")

    async def _ask(self, word: str | None) -> Any:
        assert self._pipe is not None, "entered with async with"
        return await asyncio.to_thread(_exchange, self._pipe, word)

    async def _end(self) -> None:
        assert self._pipe is not None
        self._pipe.close()
        await asyncio.to_thread(self._process.join, 2.0)
        if self._process.is_alive():
            self._process.kill()
            await asyncio.to_thread(self._process.join)


def _exchange(pipe: Connection, word: str | None) -> Any:
    """Send "cut" or "heal", nothing if *word* is None, and return the next answer of the link's process.

    Raises:
        ConfigurationError: No answer arrives within 20 s, or the process has exited.
    """
    try:
        if word is not None:
            pipe.send(word)
        if pipe.poll(_START_TIMEOUT_S):
            return pipe.recv()
    except (EOFError, OSError):
        pass
    raise ConfigurationError(
        "the process of the emulated link does not answer", hint="is the machine overloaded?"
    )


def _run(arguments: tuple[LinkProfile, str, int, int], pipe: Connection) -> None:
    """Run an `EmulatedLink` until the parent closes *pipe* or exits; entry point of the process.

    Its port is sent to *pipe* at first.  Then each "cut" or "heal" that the parent sends is performed, and
    sent back as a confirmation.

    Args:
        arguments: The profile, host and port of the server, and the seed of the link.
        pipe: The process's end of the pipe to the parent.
    """
    try:
        asyncio.run(_serve(arguments, pipe))
    except KeyboardInterrupt:
        return


async def _serve(arguments: tuple[LinkProfile, str, int, int], pipe: Connection) -> None:
    profile, host, port, seed = arguments
    over = asyncio.Event()
    async with EmulatedLink(profile, host, port, seed=seed) as link:

        def follow_order() -> None:
            try:
                word = pipe.recv()
            except (EOFError, OSError):
                link.loop.remove_reader(pipe.fileno())
                over.set()
                return
            if word in ("cut", "heal"):
                getattr(link, word)()
            pipe.send(word)

        pipe.send(link.port)
        link.loop.add_reader(pipe.fileno(), follow_order)
        await over.wait()
