"""The stage of an experiment: a local platform, its robots, and every record written while they play.

`Harness` opens the record files before anything runs, so that a killed run still tells its story.  Promises
that nothing it started is left running, and that no secret stays in the folder of results.
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
from rse_pf.errors import CommandFailed
from rse_pf.experiments.load.swarm import Swarm, SwarmOptions, SwarmResult
from rse_pf.experiments.paper.result_folder import policy_of
from rse_pf.experiments.results.records import (
    COMMANDS,
    EVENTS,
    SAMPLES,
    RecordedSample,
    SampleLog,
    reading_of,
)
from rse_pf.experiments.results.report import EventLog, write_commands
from rse_pf.local.control.platform import LocalPlatform

__all__ = [
    "Harness",
    "generator_facts",
    "watch",
]


class Harness:
    """A platform under observation; ``async with`` starts and ends it."""

    def __init__(
        self,
        folder: Path,
        settings: PlatformSettings,
        asked: Mapping[str, Any],
        *,
        elastic: bool = True,
        compress: float = 1.0,
        rebalance: bool = True,
        servers: int | None = None,
    ) -> None:
        """Describe a run; nothing is started.

        Args:
            folder: Where the records go; it is there and empty.
            settings: Of the platform.
            asked: What the first event says of this run.
            elastic: Whether monitor and scale modifier act.
            compress: By how much their periods are shortened.
            rebalance: Whether crowded servers hand robots over.
            servers: How many to begin with; None means the settings' number.
        """
        self.folder = folder
        self.settings = settings
        self.origin_s = 0.0
        self.events: list[dict[str, Any]] = []
        self.readings: list[RecordedSample] = []
        self.link: Any = None
        self._asked = dict(asked)
        self._compress = compress
        self._options = {"elastic": elastic, "compress": compress, "rebalance": rebalance, "servers": servers}
        self._stack = AsyncExitStack()
        self._news = asyncio.Event()
        self._event_log: EventLog | None = None
        self._sample_log: SampleLog | None = None
        self._cloud: LocalPlatform | None = None

    @property
    def cloud(self) -> LocalPlatform:
        """The platform."""
        assert self._cloud is not None, "entered with async with"
        return self._cloud

    async def __aenter__(self) -> Harness:
        """Open the records and start the platform; raises what LocalPlatform raises."""
        self.origin_s = time.monotonic()
        files = [
            self._stack.enter_context((self.folder / name).open("w", newline="", encoding="utf-8"))
            for name in (EVENTS, SAMPLES)
        ]
        self._event_log, self._sample_log = EventLog(files[0]), SampleLog(files[1])
        policy = policy_of(self.settings, self._compress)
        self.tell("experiment", **self._asked, **policy, origin_s=self.origin_s)
        cloud = LocalPlatform(
            self.settings,
            state=self.folder / "platform",
            port=0,
            name="experiment",
            on_event=self._heard,
            on_reading=self._read,
            **self._options,  # type: ignore[arg-type]
        )
        try:
            self._cloud = await self._stack.enter_async_context(cloud)
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the platform, close the records, remove the keys."""
        await self._stack.aclose()
        for secret in ("key.json", "keys.json"):
            (self.folder / "platform" / secret).unlink(missing_ok=True)

    def now(self) -> float:
        """Return seconds since the run began."""
        return time.monotonic() - self.origin_s

    def tell(self, action: str, **details: Any) -> None:
        """Write an event."""
        self._note(self.now(), action, details)

    def swarm(self, options: SwarmOptions) -> Swarm:
        """Return the robots of this run; enter them with ``async with``."""
        return Swarm(
            options,
            url=self.cloud.url,
            token_of=self.cloud.issue_token,
            session=self.settings.session,
            on_event=self._heard_robot,
            origin=self.origin_s,
        )

    async def until(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Wait until *condition* holds, looked at after each event and reading; return whether it did."""
        end = time.monotonic() + within_s
        while not condition():
            left = end - time.monotonic()
            if left <= 0:
                return False
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), min(left, 1.0))
            except asyncio.TimeoutError:
                continue
        return True

    async def settled(self, quiet_s: float, within_s: float) -> bool:
        """Wait until no server came, went or was asked for during *quiet_s*; return whether that was so."""
        moves = {"grow", "shrink", "replace", "server-launched", "server-healthy", "server-gone", "phase"}

        def quiet() -> bool:
            last = max((each["time"] for each in self.events if each["action"] in moves), default=0.0)
            return self.now() - last >= quiet_s

        return await self.until(quiet, within_s)

    def happened(self, action: str, since_s: float) -> list[dict[str, Any]]:
        """Return the events *action* since *since_s*."""
        return [each for each in self.events if each["action"] == action and each["time"] >= since_s]

    def busiest(self) -> Any:
        """Return the server with the most robots, as `LocalPlatform.servers` has it."""
        robots = {each.server: each.robots for each in self.readings[-1].servers} if self.readings else {}
        servers = self.cloud.servers
        if not servers:
            raise CommandFailed("no server is left", hint=f"look at {self.folder / 'platform'}/*.log")
        return max(servers, key=lambda server: (robots.get(server.name, 0), server.name))

    def kill(self, watch_s: float) -> str:
        """Send SIGKILL to the pid of the busiest server, and log it; return its name."""
        victim = self.busiest()
        self.tell("fault", fault="kill -9", server=victim.name, pid=victim.pid, watch_s=watch_s)
        os.kill(victim.pid, signal.SIGKILL)
        return str(victim.name)

    async def close_books(self, result: SwarmResult) -> None:
        """Write the robots' commands, and what the generator says of itself; nobody waits meanwhile."""
        await asyncio.to_thread(write_commands, self.folder / COMMANDS, result.commands)
        self.tell("generator", **generator_facts(result))

    def _note(self, time_s: float, action: str, details: Mapping[str, Any]) -> None:
        self.events.append({"time": time_s, "action": action, **details})
        if self._event_log is not None:
            self._event_log.write(time_s, action, **details)
        self._news.set()

    def _heard_robot(self, event: Mapping[str, Any]) -> None:
        """Write what a robot saw, at the time it saw it."""
        details = {name: value for name, value in event.items() if name not in ("event", "time", "action")}
        self._note(float(event.get("time", self.now())), str(event["event"]), details)

    def _heard(self, event: Mapping[str, Any]) -> None:
        details = {name: value for name, value in event.items() if name not in ("event", "time", "action")}
        self.tell(str(event["event"]), **details)

    def _read(self, told: Mapping[str, Any]) -> None:
        reading = reading_of(told, self.origin_s)
        self.readings.append(reading)
        if self._sample_log is not None:
            self._sample_log.write(reading)
        self._news.set()


def generator_facts(result: SwarmResult) -> dict[str, Any]:
    """Return what the robots' processes say of themselves."""
    told = ("cpu_s", "wall_s", "wrong_poses", "reconnects", "resent", "moves", "twice", "late_sends")
    return {name: getattr(result, name) for name in told}


async def watch(stage: Harness, seconds: float) -> None:
    """Let the run go on for *seconds*."""
    await stage.until(lambda: False, seconds)
