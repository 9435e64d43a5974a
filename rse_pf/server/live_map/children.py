"""The owner processes that a worker has started: each is prepared, claims one map, and ends.

When all are in use, a tenant that needs one gets that of the tenant that holds most, if that tenant holds at
least two more.  A map that is only watched gives its process up, the one that was not used for longest first,
when a map that is used needs one.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from rse_pf.child.start import Child
from rse_pf.ipc import FrameReader
from rse_pf.linux import cpu_seconds
from rse_pf.server.live_map.owner.process import OwnerOrder

__all__ = ["OwnerChild", "OwnerChildren"]

_READ_BYTES = 1 << 16
_NEXT_SPARE_S = 3.0
"""After a process was taken the next one is prepared so much later: a takeover needs the processors."""

_NEXT_CLAIM_S = 3.0
"""A map that found no process has asked again within this time, for which one is kept."""


class OwnerChild:
    """One owner process, in the event loop of its worker."""

    def __init__(self, process: Child, clock: Callable[[], float] = time.monotonic) -> None:
        """Describe the child of a started *process*; *clock* returns seconds."""
        self.tenant = ""
        """Whose map it claims or serves."""
        self.unused_s: float | None = None
        """Since when its map is only watched; None while robots send it commands."""
        self.is_leaving = False
        """It gives its map up."""
        self.last_cpu_s = 0.0
        """Its processor time, once it has ended."""
        self._clock = clock
        self.epoch: int | None = None
        """Of the owner, while it serves."""
        self.on_end: Callable[[OwnerChild, int], None] = lambda child, code: None
        """Gets this object and the exit code."""
        self._process = process
        loop = asyncio.get_running_loop()
        self._ready: asyncio.Future[bool] = loop.create_future()
        self._outcome: asyncio.Future[Literal["serving", "lost"]] = loop.create_future()
        self.ended: asyncio.Future[int] = loop.create_future()
        self._cpu_before_s = 0.0
        self._reader: asyncio.Task[None]

    def start(self) -> OwnerChild:
        """Begin to read what the process sends; return this object."""
        self._reader = asyncio.get_running_loop().create_task(self._read())
        return self

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    def begin_counting(self) -> None:
        """Count its processor time from here on: what it has imported is nobody's."""
        self._cpu_before_s = cpu_seconds(self.pid)

    def cpu_s(self) -> float:
        """Return its processor time, and that of its children that have ended; 0 if it is gone."""
        return max(0.0, cpu_seconds(self.pid) - self._cpu_before_s)

    @property
    def is_ready(self) -> bool:
        """Whether it has imported all that it needs."""
        return self._ready.done()

    async def wait_ready(self, within_s: float) -> None:
        """Wait until it has imported all that it needs, or has ended, but no longer than *within_s*."""
        await asyncio.wait({self._ready}, timeout=within_s)

    async def claim(self, order: OwnerOrder) -> bool:
        """Let it claim a map; return whether it serves it now."""
        if not await asyncio.shield(self._ready):
            return False
        self._process.say(msgspec.structs.asdict(order))
        return await asyncio.shield(self._outcome) == "serving"

    def release(self) -> None:
        """Let it release its map, and end."""
        self.is_leaving = True
        self._process.say({"do": "release"})

    def kill(self) -> None:
        """End it at once, as it is not needed."""
        self._reader.cancel()
        self._finish()

    async def _read(self) -> None:
        loop = asyncio.get_running_loop()
        self._process.connection.setblocking(False)
        frames = FrameReader(_READ_BYTES)
        with contextlib.suppress(OSError):
            while data := await loop.sock_recv(self._process.connection, _READ_BYTES):
                for message in frames.feed(data):
                    self._take(message)
        self._finish()

    def _take(self, message: list[Any]) -> None:
        match message:
            case ["ready"]:
                self._ready.set_result(True)
            case ["serving", int(epoch)]:
                self.epoch = epoch
                self._outcome.set_result("serving")
            case ["used", bool(is_used)]:
                self.unused_s = None if is_used else self._clock()
            case ["lost"]:
                self._outcome.set_result("lost")

    def _finish(self) -> None:
        """Reap the process, which has ended or is killed."""
        if self.ended.done():
            return
        self.last_cpu_s = self.cpu_s()
        code = self._process.kill()
        if not self._ready.done():
            self._ready.set_result(False)
        if not self._outcome.done():
            self._outcome.set_result("lost")
        self.ended.set_result(code)
        self.on_end(self, code)


class OwnerChildren:
    """The owner processes of one worker: those in use, and one that waits for a map."""

    def __init__(
        self, spawn: Callable[[bool], Child], *, max_owners: int, keeps_spare: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Start none yet.

        Args:
            spawn: Starts a process; calmly, if nobody waits for it yet.
            max_owners: Of them are in use at the same time.
            keeps_spare: Whether one waits for a map as soon as `use` was called.
            clock: Seconds, monotonic.
        """
        self.is_giving_up = False
        """The server drains: no further map is taken."""
        self._spawn = spawn
        self._max_owners = max_owners
        self._keeps_spare = keeps_spare
        self._clock = clock
        self._next_tenant = ""  # the process that is given up is kept for it
        self._next_until_s = float("-inf")
        self._wanted_until_s = float("-inf")
        self._used: dict[OwnerChild, None] = {}
        self._ended_cpu_s: defaultdict[str, float] = defaultdict(float)
        self._spare: OwnerChild | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def used(self) -> list[OwnerChild]:
        """Those that claim or serve a map."""
        return list(self._used)

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return the processor time of all owners so far, of those that have ended too, by tenant."""
        taken = self._ended_cpu_s.copy()
        for child in self._used:
            taken[child.tenant] += child.cpu_s()
        return dict(taken)

    @property
    def is_making_room(self) -> bool:
        """Whether a process gives its map up, so that another map has one soon."""
        return not self.is_giving_up and any(child.is_leaving for child in self._used)

    def take(
        self, tenant: str, on_end: Callable[[OwnerChild, int], None], *, only_watched: bool = False
    ) -> OwnerChild | None:
        """Return a process that may claim a map, None if no more are allowed now.

        Args:
            tenant: Whose map.
            on_end: Learns of the end of the process.
            only_watched: Nobody sends the map commands: it takes what no other map needs.
        """
        now, held = self._clock(), Counter(child.tenant for child in self._used)
        if only_watched and now < self._wanted_until_s:
            return None
        is_kept = now < self._next_until_s and held[tenant] > held[self._next_tenant]
        if len(self._used) + is_kept >= self._max_owners:
            if not only_watched:
                self._make_room(tenant, held, now)
            return None
        if tenant == self._next_tenant:
            self._next_until_s = float("-inf")
        self.prepare()
        child, self._spare = self._spare, None
        if child is not None:
            child.tenant, child.unused_s = tenant, now if only_watched else None
            child.begin_counting()
            self._used[child] = None
            child.on_end = functools.partial(self._lose, on_end)
            self._prepare_later()
        return child

    def prepare(self, *, calmly: bool = False) -> OwnerChild | None:
        """Return the process that waits for a map, which is started if one more may be used."""
        if self._spare is None and len(self._used) < self._max_owners and not self.is_giving_up:
            self._spare = OwnerChild(self._spawn(calmly), self._clock).start()
            self._spare.on_end = self._lose_spare
        return self._spare

    def use(self, *, is_used: bool) -> None:
        """Keep a process ready while live maps are used, none otherwise."""
        if is_used:
            self._prepare_later()
        else:
            self.drop_spare()

    def release(self) -> None:
        """Take no further map, and release those that are served."""
        self.is_giving_up = True
        self.drop_spare()
        for child in self.used:
            child.release()

    def drop_spare(self) -> None:
        """End the process that waits for a map."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._spare is not None:
            self._spare.kill()

    def _make_room(self, tenant: str, held: Counter[str], now: float) -> None:
        """Let one process give its map up for a map of *tenant*, if another tenant holds two more."""
        self._wanted_until_s = now + _NEXT_CLAIM_S
        if self.is_making_room and tenant == self._next_tenant:
            self._next_until_s = now + _NEXT_CLAIM_S
        if self.is_giving_up or self.is_making_room:
            return
        donors = [child for child in self._used if held[child.tenant] > held[tenant] + 1]
        unused = [
            child
            for child in self._used
            if child.unused_s is not None and (child.tenant == tenant or held[child.tenant] > held[tenant])
        ]
        if unused:
            given = min(unused, key=lambda child: (child not in donors, child.unused_s))
        elif donors:
            given = max(reversed(donors), key=lambda child: held[child.tenant])
        else:
            return
        self._next_tenant, self._next_until_s = tenant, now + _NEXT_CLAIM_S
        given.release()

    def _lose(self, on_end: Callable[[OwnerChild, int], None], child: OwnerChild, code: int) -> None:
        self._used.pop(child, None)
        self._ended_cpu_s[child.tenant] += child.last_cpu_s
        on_end(child, code)

    def _lose_spare(self, child: OwnerChild, code: int) -> None:
        self._spare = None

    def _prepare_later(self) -> None:
        if self._keeps_spare and self._timer is None and self._spare is None:
            self._timer = asyncio.get_running_loop().call_later(_NEXT_SPARE_S, self._prepare_now)

    def _prepare_now(self) -> None:
        self._timer = None
        self.prepare(calmly=True)
