"""The harness of an experiment: a local platform, its robots, and the files with the records of the run.

`Harness` opens the record files before it starts a process, so that a killed run leaves its events.  At the
end it stops every process that it started, and deletes the keys from the folder of results.
"""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.load.swarm import Swarm, SwarmResult
from rse_pf.extensions.experiments.results.records import (
    COMMANDS,
    EVENTS,
    SAMPLES,
    EventLog,
    Records,
    SampleLog,
    event_details,
    sample_from_document,
    write_commands,
)
from rse_pf.extensions.recording.platform_recorder import make_platform_recorder
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.monitor import MonitorSample
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.state import remove_keys
from rse_pf.scaling.profile import cadence_of

__all__ = ["Harness", "generator_event", "generator_of", "policy_parameters"]

# Events of the platform after which `Harness.wait_quiet` begins its wait again.
_SERVER_CHANGES = {
    "grow", "shrink", "replace", "server-launched", "server-healthy", "server-gone", "phase",
}  # fmt: skip


class Harness:
    """A platform whose events and samples are recorded; ``async with`` starts and stops the platform."""

    def __init__(
        self,
        folder: Path,
        settings: PlatformSettings,
        parameters: Mapping[str, Any] | None = None,
        *,
        data: bool = False,
        elastic: bool = True,
        compress: float = 1.0,
        rebalance: bool = True,
        servers: int | None = None,
    ) -> None:
        """Describe a run; nothing is started.

        Args:
            folder: Folder of the records; it exists and is empty.
            settings: Settings of the platform.
            parameters: Parameters of this run, for its first event; None if the caller records them later.
            data: Whether the platform has data servers.
            elastic: Whether the monitor and the scale modifier run, which add and remove servers.
            compress: Factor by which the periods of the scaling policy are divided.
            rebalance: Whether robots migrate from servers with many robots to others.
            servers: Number of servers at the start; None means that of the settings.
        """
        self.folder = folder
        self.settings = settings
        self.origin_s = 0.0
        self.events: list[dict[str, Any]] = []
        self.samples: list[MonitorSample] = []
        self.link: Any = None
        self._parameters = (
            None if parameters is None else {**parameters, **policy_parameters(settings, compress)}
        )
        self._data = data
        self._servers = servers
        self._control = ControlOptions(
            elastic=elastic, compress=compress, rebalance=rebalance, on_sample=self._on_sample
        )
        self._stack = AsyncExitStack()
        self._changed = asyncio.Event()
        self._event_log: EventLog
        self._sample_log: SampleLog
        self.platform: LocalPlatform

    async def __aenter__(self) -> Harness:
        """Open the record files and start the platform; an error of LocalPlatform is raised."""
        self.origin_s = time.monotonic()
        events, samples = (
            self._stack.enter_context((self.folder / name).open("w", newline="", encoding="utf-8"))
            for name in (EVENTS, SAMPLES)
        )
        self._event_log, self._sample_log = EventLog(events), SampleLog(samples)
        if self._parameters is not None:
            self.log("experiment", **self._parameters, origin_s=self.origin_s)
        platform = LocalPlatform(
            self.settings,
            state=self.folder / "platform",
            port=0,
            name="experiment",
            on_event=lambda event: self.log(str(event["event"]), **event_details(event)),
            data=self._data,
            servers=self._servers,
            control=self._control,
            recorder=make_platform_recorder(self.settings, self.folder / "platform"),
        )
        try:
            self.platform = await self._stack.enter_async_context(platform)
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the platform, close the record files and delete the platform's keys."""
        await self._stack.aclose()
        remove_keys(self.folder / "platform")

    def now(self) -> float:
        """Return seconds since the start of the run."""
        return time.monotonic() - self.origin_s

    def log(self, action: str, **details: Any) -> None:
        """Record the event *action* with *details* and the present time."""
        self._record(self.now(), action, details)

    def swarm(self, options: LoadScenario) -> Swarm:
        """Return the robots of this run, not yet started.

        ``async with`` starts them, and their events are recorded.
        """
        return Swarm(
            options,
            url=self.platform.url,
            token_of=self.platform.issue_token,
            session=self.settings.session,
            on_event=lambda event: self._record(
                float(event.get("time", self.now())), str(event["event"]), event_details(event)
            ),
            origin=self.origin_s,
        )

    async def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until *condition* returns True; return False if that did not happen within *timeout_s*.

        *condition* is called after each event and sample, and at least once a second.
        """
        end = time.monotonic() + timeout_s
        while not condition():
            left = end - time.monotonic()
            if left <= 0:
                return False
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), min(left, 1.0))
            except asyncio.TimeoutError:
                continue
        return True

    async def run_for(self, seconds: float) -> None:
        """Wait *seconds* while the run continues and events and samples are recorded."""
        await self.wait_for(lambda: False, seconds)

    async def wait_quiet(self, quiet_s: float, timeout_s: float) -> bool:
        """Wait until no server was added, removed or replaced for *quiet_s*.

        Return False if that did not happen within *timeout_s*.
        """

        def quiet() -> bool:
            times = (event["time"] for event in self.events if event["action"] in _SERVER_CHANGES)
            return self.now() - max(times, default=0.0) >= quiet_s

        return await self.wait_for(quiet, timeout_s)

    def events_since(self, action: str, since_s: float) -> list[dict[str, Any]]:
        """Return the recorded events named *action* at or after *since_s* (s since the start of the run)."""
        return [event for event in self.events if event["action"] == action and event["time"] >= since_s]

    def busiest(self) -> Any:
        """Return the server with the most robots in the last sample, an entry of `LocalPlatform.servers`.

        Raises:
            CommandFailed: No server is running.
        """
        robots = {row.name: row.robots for row in self.samples[-1].servers} if self.samples else {}
        servers = self.platform.servers
        if not servers:
            raise CommandFailed("no server is left", hint=f"look at {self.folder / 'platform'}/*.log")
        return max(servers, key=lambda server: (robots.get(server.name, 0), server.name))

    def kill(self, watch_s: float) -> str:
        """Send SIGKILL to the server with the most robots, record the fault, and return the server's name.

        *watch_s* is the time after the fault in which outages are counted for it.
        """
        victim = self.busiest()
        self.log("fault", fault="kill -9", server=victim.name, pid=victim.pid, watch_s=watch_s)
        os.kill(victim.pid, signal.SIGKILL)
        return str(victim.name)

    async def save_result(self, result: SwarmResult) -> None:
        """Write ``commands.csv`` and the event ``generator`` with the figures of the load generator."""
        await asyncio.to_thread(write_commands, self.folder / COMMANDS, result.commands)
        self.log("generator", **generator_event(result))

    def _record(self, time_s: float, action: str, details: Mapping[str, Any]) -> None:
        self.events.append({"time": time_s, "action": action, **details})
        self._event_log.write(time_s, action, **details)
        self._changed.set()

    def _on_sample(self, document: Mapping[str, Any]) -> None:
        sample = sample_from_document(document, self.origin_s)
        self.samples.append(sample)
        self._sample_log.write(sample)
        self._changed.set()


def generator_event(result: SwarmResult) -> dict[str, Any]:
    """Return the figures of the load generator in *result* as the details of the event ``generator``."""
    same = ("cpu_s", "wall_s", "wrong_poses", "reconnects", "resent", "moves")
    return {
        **{name: getattr(result, name) for name in same},
        "twice": result.duplicates,
        "late_sends": result.late_sends_ms_p99,
    }


def generator_of(records: Records) -> dict[str, Any]:
    """Return the details of the event ``generator`` of a run; raises UsageError if the run did not finish."""
    for event in records.events:
        if event["action"] == "generator":
            return event_details(event)
    raise UsageError("the events hold no figures of the load generator", hint="run the experiment again")


def policy_parameters(settings: PlatformSettings, compress: float) -> dict[str, Any]:
    """Return the parameters of the scaling policy for the records, with its times divided by *compress*."""
    scaling, cadence = settings.scaling, cadence_of(settings.scaling)
    return {
        "min_servers": scaling.min_servers,
        "max_servers_allowed": scaling.max_servers,
        "busy_cpu_percent": scaling.busy_cpu_percent,
        "busy_periods": cadence.busy,
        "period_s": cadence.period_s / compress,
        "idle_s": scaling.idle_s / compress,
        "size": settings.serving.emulated_cores,
    }
