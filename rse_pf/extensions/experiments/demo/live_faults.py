"""The faults of a demo with a live map, injected into its platform while the robots drive.

The time of the fault is drawn with a seed.  The lease of the map in the object store is read every 20 ms, and
each change of it is recorded as an event; `rse_pf.extensions.experiments.results.live_faults` computes
figures from these events.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, NotFound, RsePfError
from rse_pf.extensions.experiments.demo.live import LIVE_NAME
from rse_pf.extensions.experiments.faults.failing_store import failing_environment, set_failing_percent
from rse_pf.extensions.experiments.faults.network_emulator import PROFILES, LinkProcess
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.faults import signal_tree
from rse_pf.server.live_map.lease import LeaseRecord, decode_lease, lease_name
from rse_pf.storage.object_store import DirectoryStore

__all__ = ["LIVE_FAULTS", "Disturbance", "LiveFault"]

LIVE_FAULTS = {
    "none": 0.0, "kill": 0.0, "stop": 10.0, "drain": 0.0, "roll": 0.0, "store": 10.0, "wifi": 30.0
}  # fmt: skip
"""Every fault of a live map by its name in ``--only``, and its duration in seconds.

0 for one without a duration.
"""
# Percentage of the operations of the object store that fail during the fault "store".
_FAILING_PERCENT = 30.0
# Earliest time of a fault, as a fraction of the drive.
_EARLIEST_FAULT = 0.16
# Latest time of a fault, as a fraction of the drive; a long fault begins in the first half of the interval.
_LATEST_FAULT = 0.5
# Duration, in seconds, above which a fault is a long one.
_LONG_FAULT_S = 20.0
# Time between two reads of the map's lease, in seconds.
_LEASE_POLL_S = 0.02
# Longest wait until a map server serves the map, in seconds.
_MAP_SERVER_TIMEOUT_S = 20.0
# Number (from 0) of the robot whose link the fault "wifi" cuts.
_CUT_ROBOT = 0
# During the fault "wifi", a robot solves a pose itself if the cloud has not answered within this time, in
# seconds.
_OFFLINE_ANSWER_S = 0.5

Log = Callable[..., None]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveFault:
    """One fault of `LIVE_FAULTS`; ``seed`` determines the time at which it is injected."""

    name: str
    seed: int = 0

    @property
    def has_offload(self) -> bool:
        """Whether robots solve poses themselves if the cloud does not answer, and store keyframes on disk."""
        return self.name == "wifi"

    def settings(self, settings: PlatformSettings) -> PlatformSettings:
        """Return *settings* changed for this fault: the log of the map is never shortened.

        The complete log is replayed later.  For "wifi", a pose must be answered within 0.5 s.
        """
        changed = settings.replace(live={"keep_log": True})
        return (
            changed.replace(session={"answer_timeout_s": _OFFLINE_ANSWER_S}) if self.has_offload else changed
        )

    def moment_s(self, drive_s: float) -> float:
        """Return the time at which the fault begins in a drive of *drive_s*; both in seconds."""
        latest = (
            (_EARLIEST_FAULT + _LATEST_FAULT) / 2 if LIVE_FAULTS[self.name] > _LONG_FAULT_S else _LATEST_FAULT
        )
        return drive_s * random.Random(self.seed).uniform(_EARLIEST_FAULT, latest)

    def environment(self, folder: Path) -> contextlib.AbstractContextManager[None]:
        """Return the environment in which the platform must be started; for "store", its stores can fail."""
        return failing_environment(folder) if self.name == "store" else contextlib.nullcontext()

    @contextlib.asynccontextmanager
    async def disturb(self, platform: LocalPlatform, store: Path, log: Log) -> AsyncIterator[Disturbance]:
        """Record the changes of the map's lease, and yield the object that injects the fault.

        *store* is the folder of the demo; *log* records an event.
        """
        async with AsyncExitStack() as stack:
            link = None
            if self.name == "wifi":
                parts = urlsplit(platform.url)
                link = await stack.enter_async_context(
                    LinkProcess(PROFILES["none"], parts.hostname or "", parts.port or 0)
                )
            disturbance = Disturbance(self, platform, store, link, log)
            disturbance.watch()
            try:
                yield disturbance
            finally:
                await disturbance.end()


class Disturbance:
    """Injects a fault into a running demo, and records the changes of the map's lease."""

    def __init__(
        self, fault: LiveFault, platform: LocalPlatform, folder: Path, link: LinkProcess | None, log: Log
    ) -> None:
        self._fault, self._platform, self._folder = fault, platform, folder
        self._link, self._log = link, log
        self._store = DirectoryStore(folder / "platform" / "objects")
        self._lease: LeaseRecord | None = None
        self._watching: asyncio.Task[None] | None = None
        self._acting: asyncio.Task[None] | None = None

    @property
    def parameters(self) -> dict[str, Any]:
        """The fault and its seed, for the parameters of the run."""
        return {"fault": self._fault.name, "fault_seed": self._fault.seed}

    def watch(self) -> None:
        """Start the task that records the changes of the map's lease."""
        self._watching = asyncio.create_task(self._watch())

    def url_of(self, robot: int) -> str:
        """Return the address for the robot of number *robot* (from 0).

        For the fault "wifi", the first robot's address is that of the link which is cut.
        """
        if self._link is None or robot != _CUT_ROBOT:
            return self._platform.url
        return urlsplit(self._platform.url)._replace(netloc=f"127.0.0.1:{self._link.port}").geturl()

    def begin(self, start_after_s: float, drive_s: float) -> None:
        """Start the task that injects the fault at its time.

        The robots start in *start_after_s* seconds and drive for *drive_s* seconds.
        """
        self._acting = asyncio.create_task(self._act(start_after_s + self._fault.moment_s(drive_s)))

    async def finish(self) -> None:
        """Wait until the fault is over; an error of its injection is raised."""
        if self._acting is not None:
            await self._acting

    async def end(self) -> None:
        """Cancel the tasks that inject the fault and record the lease."""
        tasks = [task for task in (self._watching, self._acting) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _act(self, after_s: float) -> None:
        await asyncio.sleep(after_s)
        name, seconds = self._fault.name, LIVE_FAULTS[self._fault.name]
        if name == "none":
            return
        owner = await self._owner()
        event = {"fault": name, "seconds": seconds}
        if name == "wifi":
            assert self._link is not None
            self._log("fault", **event, robot=f"robot-{_CUT_ROBOT + 1}")
            await self._link.cut()
            await asyncio.sleep(seconds)
            await self._link.heal()
        elif name == "store":
            self._log("fault", **event, percent=_FAILING_PERCENT)
            await self._fail_store(seconds)
        else:
            self._log("fault", **event, owner=owner.owner, server=owner.server)
            await self._disturb_server(name, owner.server, seconds)
        self._log("fault-over", fault=name)

    async def _disturb_server(self, fault: str, name: str, seconds: float) -> None:
        """Kill, drain or replace the server *name*, or stop all of its processes for *seconds*."""
        if fault == "kill":
            self._platform.kill(name)
        elif fault == "drain":
            await self._platform.drain(name, reason="experiment: drain of the owner's server")
        elif fault == "roll":
            await self._platform.roll()
        else:
            server = next(candidate for candidate in self._platform.servers if candidate.name == name)
            self._log("stopped", processes=signal_tree(server.mark, signal.SIGSTOP))
            try:
                await asyncio.sleep(seconds)
            finally:
                signal_tree(server.mark, signal.SIGCONT)

    async def _fail_store(self, seconds: float) -> None:
        folder = self._folder / "failing-store"
        set_failing_percent(folder, _FAILING_PERCENT)
        try:
            await asyncio.sleep(seconds)
        finally:
            set_failing_percent(folder, 0.0)

    async def _owner(self) -> LeaseRecord:
        """Wait until a map server serves the map, and return its lease.

        Raises:
            CommandFailed: No map server served the map within 20 s.
        """
        for _ in range(round(_MAP_SERVER_TIMEOUT_S / _LEASE_POLL_S)):
            if self._lease is not None and self._lease.state == "serving":
                return self._lease
            await asyncio.sleep(_LEASE_POLL_S)
        raise CommandFailed("no server serves the live map", hint="let the robots drive for longer")

    async def _watch(self) -> None:
        """Record each change of the lease's holder or state, until cancelled; renewals are not recorded."""
        name = lease_name(DEFAULT_TENANT, LIVE_NAME)
        while True:
            with contextlib.suppress(NotFound, RsePfError):
                record = decode_lease(name, await asyncio.to_thread(self._store.get, name))
                known, self._lease = self._lease, record
                if known is None or (record.owner, record.state) != (known.owner, known.state):
                    self._log(
                        "lease",
                        owner=record.owner,
                        server=record.server,
                        state=record.state,
                        epoch=record.epoch,
                    )
            await asyncio.sleep(_LEASE_POLL_S)
