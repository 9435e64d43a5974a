"""Start the map-server processes of one worker, and share them between maps and tenants.

A worker has at most ``live.max_owners`` map servers.  When all are in use and another map gets commands, one
map is given up: its process exits, and a new process serves the map in need.  The map that is given up is of
the first of these kinds that exists:

1. a map that is only watched, of a tenant that holds at least two processes more than the tenant in need;
2. a map that is only watched, of the tenant in need itself, or of a tenant that holds more processes;
3. a map in use of the tenant that holds most processes, if these are at least two more than those of the
   tenant in need.

A map counts as only watched if it gets no commands.  Of several such maps, the one without commands for
longest is given up; of several maps of the third kind, the one whose process was taken last.  If there is no
map of these kinds, requests to the map in need fail with Busy.

One process without a map, the spare, may be started in advance, so that a takeover does not wait for imports.
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

from rse_pf.config import PlatformSettings
from rse_pf.processes.ipc import FrameReader
from rse_pf.processes.linux import cpu_seconds
from rse_pf.processes.start import Child, ChildPlan, start_child

__all__ = ["DEFAULT_IMPLEMENTATION", "ClaimOrder", "MapServerPool", "MapServerProcess", "start_map_server"]

DEFAULT_IMPLEMENTATION = "rse_pf.server.live_map.map_server.environment:LIVE_MAP"
"""Location of the `MapImplementation` that map servers use in operation, as ``module:name``."""
_PROCESS_ENTRY_POINT = "rse_pf.server.live_map.map_server.process:run"
"""Function that a map server's process runs, as ``module:name``; the worker does not import this module."""
_MAX_MEMORY_BYTES = 2 << 30
"""Memory limit in bytes of one map server's process; a process that needs more exits, and another process
takes its map over."""
_SPARE_IMPORT_NICE = 10
"""Additional niceness of a spare process while it imports modules, because nobody waits for it."""
_READ_BYTES = 1 << 16  # largest number of bytes that one read of a process's socket returns
_SPARE_DELAY_S = 3.0
"""Seconds after a process was taken until the next spare is started, so that the imports of the spare do not
compete for the CPU with the process that restores a map."""
_RESERVATION_S = 3.0
"""Seconds after a map with commands got no process during which the next free process is reserved for the
tenant of that map, and maps that are only watched get none.  The map asks again within this time."""


class ClaimOrder(msgspec.Struct, frozen=True, kw_only=True):
    """Order a map server's process to claim one live map.

    Attributes:
        tenant: Tenant of the map.
        map_name: Name of the map.
        server: Id of the backend server.
        known: Content of the lease as the worker read it, None if there was no lease.  The claim fails if
            the lease has changed since then.
    """

    tenant: str
    map_name: str
    server: str
    known: bytes | None


def start_map_server(
    settings: PlatformSettings, implementation: str = DEFAULT_IMPLEMENTATION, *, at_low_priority: bool = False
) -> Child:
    """Start a map server's process, which then waits for a `ClaimOrder`; return before it is ready.

    Called only in the main thread of a worker: Linux kills the process when that thread ends.

    Args:
        settings: Settings of the platform.
        implementation: Location of a `MapImplementation`, as ``module:name``.
        at_low_priority: Whether the process imports its modules at low priority, because nobody waits for it
            yet.
    """
    child = start_child(
        ChildPlan(
            target=_PROCESS_ENTRY_POINT,
            name="rse-pf live map",
            memory_bytes=_MAX_MEMORY_BYTES,
            import_nice=_SPARE_IMPORT_NICE if at_low_priority else 0,
        )
    )
    child.say({"settings": settings.to_dict(), "kind": implementation})
    return child


class MapServerProcess:
    """One map server's process, as its worker sees it; all methods are called in the event loop."""

    def __init__(self, process: Child, clock: Callable[[], float] = time.monotonic) -> None:
        """Describe a started *process*; *clock* returns monotonic seconds."""
        self.tenant = ""
        """Tenant of the map that the process claims or serves; empty for a spare."""
        self.unused_since_s: float | None = None
        """Monotonic time since which its map is only watched; None while commands arrive, and for a spare."""
        self.is_releasing = False
        """Whether the process was ordered to release its map."""
        self.final_cpu_s = 0.0
        """CPU time in seconds that the process used for its map, set when it has exited."""
        self.epoch: int | None = None
        """Epoch of the process's lease; None until the process serves its map."""
        self.on_exit: Callable[[MapServerProcess, int], None] = lambda process, exit_code: None
        """Called with this object and the exit code when the process has exited."""
        self._clock = clock
        self._process = process
        loop = asyncio.get_running_loop()
        self._ready: asyncio.Future[bool] = loop.create_future()
        self._outcome: asyncio.Future[Literal["serving", "lost"]] = loop.create_future()
        self.exited: asyncio.Future[int] = loop.create_future()
        """A future that gets the exit code when the process has exited; negative for a signal."""
        self._cpu_before_map_s = 0.0  # CPU time of the process before it was assigned to a map
        self._reader: asyncio.Task[None]

    def start_reading(self) -> MapServerProcess:
        """Start the task that reads the messages of the map server's process, and return this object."""
        self._reader = asyncio.get_running_loop().create_task(self._read())
        return self

    @property
    def pid(self) -> int:
        """Process id of the map server."""
        return self._process.pid

    def assign(self, tenant: str, *, is_watched_only: bool) -> None:
        """Count the process for a map of *tenant*, and its CPU time from now on; no order is sent yet."""
        self.tenant = tenant
        self.unused_since_s = self._clock() if is_watched_only else None
        self._cpu_before_map_s = cpu_seconds(self.pid)

    def cpu_s(self) -> float:
        """Return the CPU seconds of the process and its exited children since `assign`; 0 after its exit."""
        return max(0.0, cpu_seconds(self.pid) - self._cpu_before_map_s)

    @property
    def is_ready(self) -> bool:
        """Whether the process has imported its modules, so that it can take an order, or has exited."""
        return self._ready.done()

    async def wait_ready(self, timeout_s: float) -> None:
        """Wait at most *timeout_s* seconds until the process has imported its modules, or has exited."""
        await asyncio.wait({self._ready}, timeout=timeout_s)

    async def claim(self, order: ClaimOrder) -> bool:
        """Send *order* when the process is ready; wait until it serves the map, and return whether it does.

        False means that another process has claimed the map, that the map could not be restored, or that this
        process has exited.
        """
        if not await asyncio.shield(self._ready):
            return False
        self._process.say(msgspec.structs.asdict(order))
        return await asyncio.shield(self._outcome) == "serving"

    def release(self) -> None:
        """Order the process to give its map up and exit; return at once."""
        self.is_releasing = True
        self._process.say({"do": "release"})

    def kill(self) -> None:
        """Kill the process at once, reap it and call ``on_exit``; only for a process that serves no map."""
        self._reader.cancel()
        self._finish()

    async def _read(self) -> None:
        loop = asyncio.get_running_loop()
        self._process.connection.setblocking(False)
        frames = FrameReader(_READ_BYTES)
        with contextlib.suppress(OSError):
            while data := await loop.sock_recv(self._process.connection, _READ_BYTES):
                for message in frames.feed(data):
                    self._handle(message)
        self._finish()

    def _handle(self, message: list[Any]) -> None:
        match message:
            case ["ready"]:
                self._ready.set_result(True)
            case ["serving", int(epoch)]:
                self.epoch = epoch
                self._outcome.set_result("serving")
            case ["used", bool(is_used)]:
                self.unused_since_s = None if is_used else self._clock()
            case ["lost"]:
                self._outcome.set_result("lost")

    def _finish(self) -> None:
        """Kill the process if it still runs, reap it, complete its futures, and call ``on_exit``."""
        if self.exited.done():
            return
        self.final_cpu_s = self.cpu_s()
        exit_code = self._process.kill()
        if not self._ready.done():
            self._ready.set_result(False)
        if not self._outcome.done():
            self._outcome.set_result("lost")
        self.exited.set_result(exit_code)
        self.on_exit(self, exit_code)


class MapServerPool:
    """The map-server processes of one worker: those that claim or serve a map, and at most one spare."""

    def __init__(
        self,
        start_process: Callable[[bool], Child],
        *,
        max_processes: int,
        keeps_spare: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare the pool; no process is started yet.

        Args:
            start_process: Starts a process; called with whether it imports its modules at low priority.
            max_processes: Largest number of processes that claim or serve a map at the same time, without the
                spare.
            keeps_spare: Whether a spare is kept while live maps are used.
            clock: Returns monotonic time in seconds.
        """
        self.is_draining = False
        """Whether the server drains, so that no further process is started or taken."""
        self._start_process = start_process
        self._max_processes = max_processes
        self._keeps_spare = keeps_spare
        self._clock = clock
        self._reserved_for = ""  # tenant for which the next free process is reserved until _reserved_until_s
        self._reserved_until_s = float("-inf")
        self._wanted_until_s = float("-inf")  # until then, maps that are only watched get no process
        self._in_use: dict[MapServerProcess, None] = {}
        self._cpu_s_of_exited: defaultdict[str, float] = defaultdict(float)
        self._spare: MapServerProcess | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def in_use(self) -> list[MapServerProcess]:
        """Map-server processes that claim or serve a map, in the order in which they were taken."""
        return list(self._in_use)

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return the CPU seconds of all map servers of this worker so far, also of exited ones, by tenant.

        The time of a process counts from its assignment to a map on.
        """
        cpu_s = self._cpu_s_of_exited.copy()
        for process in self._in_use:
            cpu_s[process.tenant] += process.cpu_s()
        return dict(cpu_s)

    @property
    def is_freeing_process(self) -> bool:
        """Whether a map server is giving its map up, so that another map can have a process soon.

        False while the pool drains: all map servers give their maps up then, and no other map gets a process.
        """
        return not self.is_draining and any(process.is_releasing for process in self._in_use)

    def take(
        self,
        tenant: str,
        on_exit: Callable[[MapServerProcess, int], None],
        *,
        is_watched_only: bool = False,
    ) -> MapServerProcess | None:
        """Assign a process to a map and return it, or return None if the map must ask again later.

        The returned process may still import its modules.  If all processes are in use and the map has
        commands, another map may be ordered to give up its process for a later call.

        Args:
            tenant: Tenant of the map.
            on_exit: Called with the process and its exit code when it has exited.
            is_watched_only: Whether nobody sends commands to the map; it then gets only a process that no
                other map needs.
        """
        now = self._clock()
        in_use_by_tenant = Counter(process.tenant for process in self._in_use)
        # 1. Refuse a map that is only watched while a map that gets commands may still ask for a process.
        if is_watched_only and now < self._wanted_until_s:
            return None
        # 2. Leave one process free if it is reserved for a tenant that holds fewer processes than *tenant*.
        is_reserved = (
            now < self._reserved_until_s and in_use_by_tenant[tenant] > in_use_by_tenant[self._reserved_for]
        )
        # 3. If no process is left, let a map give one up for a later call.
        if len(self._in_use) + is_reserved >= self._max_processes:
            if not is_watched_only:
                self._free_process(tenant, in_use_by_tenant, now)
            return None
        if tenant == self._reserved_for:
            self._reserved_until_s = float("-inf")
        # 4. Assign the spare, which is started now if there is none, and start the next spare 3 s later.
        self.prepare_spare()
        process, self._spare = self._spare, None
        if process is not None:
            process.assign(tenant, is_watched_only=is_watched_only)
            process.on_exit = functools.partial(self._remove, on_exit)
            self._in_use[process] = None
            self._prepare_spare_later()
        return process

    def prepare_spare(self, *, at_low_priority: bool = False) -> MapServerProcess | None:
        """Return the spare process, which is started if there is none; None if the pool is full or drains.

        *at_low_priority* has no effect on a spare that was started before.
        """
        if self._spare is None and len(self._in_use) < self._max_processes and not self.is_draining:
            started = self._start_process(at_low_priority)
            self._spare = MapServerProcess(started, self._clock).start_reading()
            self._spare.on_exit = self._remove_spare
        return self._spare

    def set_used(self, *, is_used: bool) -> None:
        """Note whether a live map may need a process: start a spare in 3 s, or kill the spare.

        A spare is started only if the pool keeps spares.
        """
        if is_used:
            self._prepare_spare_later()
        else:
            self.kill_spare()

    def release_all(self) -> None:
        """Order all map servers of the pool to give their maps up; start or take no process any more.

        The spare is killed.
        """
        self.is_draining = True
        self.kill_spare()
        for process in self.in_use:
            process.release()

    def kill_spare(self) -> None:
        """Kill the spare process, and cancel the timer that would start another one.

        This is called when no live map is used any more, and when the pool drains.
        """
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._spare is not None:
            self._spare.kill()

    def _free_process(self, tenant: str, in_use_by_tenant: Counter[str], now: float) -> None:
        """Order a map server to give its map up, and reserve its process for *tenant*.

        The docstring of this module says which one.  Nothing is ordered while the pool drains or another map
        is being given up; in the second case, a reservation for *tenant* is prolonged.

        Args:
            tenant: Tenant of the map that needs a process.
            in_use_by_tenant: Number of processes of each tenant that claim or serve a map.
            now: Monotonic time in seconds.
        """
        self._wanted_until_s = now + _RESERVATION_S
        if self.is_freeing_process and tenant == self._reserved_for:
            self._reserved_until_s = now + _RESERVATION_S
        if self.is_draining or self.is_freeing_process:
            return
        own = in_use_by_tenant[tenant]
        of_larger_tenants = [
            process for process in self._in_use if in_use_by_tenant[process.tenant] > own + 1
        ]
        unused = [
            process
            for process in self._in_use
            if process.unused_since_s is not None
            and (process.tenant == tenant or in_use_by_tenant[process.tenant] > own)
        ]
        if unused:
            released = min(
                unused, key=lambda process: (process not in of_larger_tenants, process.unused_since_s)
            )
        elif of_larger_tenants:
            released = max(reversed(of_larger_tenants), key=lambda process: in_use_by_tenant[process.tenant])
        else:
            return
        self._reserved_for, self._reserved_until_s = tenant, now + _RESERVATION_S
        released.release()

    def _remove(
        self, on_exit: Callable[[MapServerProcess, int], None], process: MapServerProcess, exit_code: int
    ) -> None:
        self._in_use.pop(process, None)
        self._cpu_s_of_exited[process.tenant] += process.final_cpu_s
        on_exit(process, exit_code)

    def _remove_spare(self, process: MapServerProcess, exit_code: int) -> None:
        self._spare = None

    def _prepare_spare_later(self) -> None:
        """Start a spare in 3 s, if the pool keeps spares, has none, and no such timer is set."""
        if self._keeps_spare and self._timer is None and self._spare is None:
            self._timer = asyncio.get_running_loop().call_later(_SPARE_DELAY_S, self._start_spare_now)

    def _start_spare_now(self) -> None:
        self._timer = None
        self.prepare_spare(at_low_priority=True)
