"""The servers of one local platform in operation, each from its launch until its process is gone.

The fleet decides which servers may get robots, emits every change as an event, and carries out launches,
drains and replacements that others decide.  A server that is to drain is removed from the balancer's targets
before it is asked to, and a name is never used twice.
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
import signal
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.config.elasticity import MOVE_WITHIN_MS
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.local.control.monitor import Observed, ServerPhase
from rse_pf.local.processes import STOP_TIMEOUT_S
from rse_pf.local.servers.backend_servers import BackendServer, LocalBackendServers
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.scaling.health import Health, time_to_notice_s

__all__ = ["Fleet", "FleetReports", "Member", "ServerHealth"]

# Time limit of a request to drain, in seconds.
_DRAIN_REQUEST_S = 2.0
# Longest wait for the balancer's answer before the state of the server is read again, in seconds.
_LOOK_UP_S = 0.5
# Pause between two such waits, in seconds.
_PAUSE_S = 0.02
# Time after which tasks that did not end are cancelled again, in seconds.
_CANCEL_AGAIN_S = 0.2
# A standby starts when no server became healthy for this long, in seconds, so that it delays no start.
_CALM_S = 3.0
_PREFIX = "server-"
# A server that ends sooner after it became healthy, in seconds, counts in `MAX_RESTARTS_PER_MINUTE`.
_MIN_UPTIME_S = 10.0


@dataclass(slots=True, kw_only=True)
class Member:
    """One server.

    ``leaving``: it drains; ``out``: it was replaced and is killed; ``on_trial``: it was started by a roll,
    and is not replaced until it was healthy.

    Times are monotonic seconds; those of ``health`` are compressed with the rest.
    """

    name: str
    launched_s: float
    health: Health
    server: BackendServer | None = None
    healthy_s: float | None = None
    healthy: asyncio.Event = field(default_factory=asyncio.Event)
    over: asyncio.Event = field(default_factory=asyncio.Event)
    leaving: bool = False
    out: bool = False
    on_trial: bool = False
    replaces_living: bool = False
    adopted: bool = False
    robots: int = 0
    observed: Observed | None = None

    @property
    def phase(self) -> ServerPhase:
        """The state as it is in a sample."""
        if self.leaving:
            return "draining"
        if self.out or self.health.state == "unhealthy":
            return "unhealthy"
        return "healthy" if self.healthy_s is not None and self.health.state == "healthy" else "starting"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerHealth:
    """Numbers and names of servers by state.

    ``servers`` counts all that exist or should: those that start, serve, fail their checks or ended
    unexpectedly, but not those that drain.  ``broken`` run but fail their checks; ``dead`` have ended,
    each with whether it ended soon after its start.  ``replacing`` counts replacements that do not serve yet.
    """

    servers: int
    warming: int = 0
    healthy: int = 0
    replacing: int = 0
    broken: tuple[str, ...] = ()
    dead: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FleetReports:
    """Callbacks: *emit* takes an event with details, *changed* writes the state file."""

    emit: Callable[..., None]
    changed: Callable[[], None]


class Fleet:
    """The members, by name."""

    def __init__(
        self,
        backend_servers: LocalBackendServers,
        load_balancer: EnvoyLoadBalancer,
        settings: PlatformSettings,
        *,
        compress: float,
        reports: FleetReports,
    ) -> None:
        """Make a fleet without members."""
        self.members: dict[str, Member] = {}
        self.dead: dict[str, bool] = {}
        self.launched = 0
        self._backend_servers = backend_servers
        self._load_balancer = load_balancer
        self.settings = settings
        self._compress = compress
        self._calm_s = _CALM_S / compress
        self._warm_up_s = settings.scaling.warm_up_s / compress
        self._emit = reports.emit
        self._changed = reports.changed
        self.is_full: Callable[[], bool] = lambda: False
        """Return whether the disk is full; no server is launched then, since it could not announce itself."""
        self._tasks: set[asyncio.Task[Any]] = set()
        self._still_targets: set[str] = set()
        self.on_ready: Callable[[Member], None] = lambda member: None
        self.on_healthy: Callable[[], None] = lambda: None
        self.on_lost: Callable[[], None] = lambda: None

    @property
    def serving(self) -> tuple[BackendServer, ...]:
        """The servers that have announced themselves and neither ended nor are to leave."""
        return tuple(
            member.server
            for member in self.members.values()
            if member.server is not None and not member.leaving and not member.out
        )

    def member(self, name: str) -> Member:
        """Return the member called *name*; raises UsageError."""
        if name not in self.members:
            running = ", ".join(self.members) or "none"
            raise UsageError(f"no server named {name!r} is running", hint=f"running are {running}")
        return self.members[name]

    def control(self, server: BackendServer) -> ControlPort:
        """Return a client of the control port of *server*."""
        return self._backend_servers.control(server.control_port)

    def is_warming(self, member: Member, now_s: float) -> bool:
        """Return whether the CPU of *member* does not count yet: it counts some time after it took robots."""
        if member.adopted:
            return False
        return member.healthy_s is None or now_s - member.healthy_s < self._warm_up_s

    # --- from the launch to the first robot -----------------------------------------------------

    def launch(self, *, replaces_living: bool = False) -> Member:
        """Start the process of a new server, and return before it listens; `bring_up` must follow."""
        self.launched += 1
        name = f"{_PREFIX}{self.launched}"
        now_s = time.monotonic()
        member = Member(
            name=name,
            launched_s=now_s,
            health=Health(started_s=now_s * self._compress),
            replaces_living=replaces_living,
        )
        self._backend_servers.launch(name)
        self.members[name] = member
        mark = self._backend_servers.marks.get(name)
        self._changed()
        self._emit("server-launched", server=name, pid=None if mark is None else mark.pid)
        return member

    def adopt(self, name: str, *, now_s: float, is_target: bool) -> Member:
        """Take over a server of an earlier control plane; `bring_up` must follow.

        Its health checks count at once, without the grace period of a new server.  The targets of the
        balancer stay unchanged until every server that *is_target* has been adopted.
        """
        number = name.removeprefix(_PREFIX)
        self.launched = max(self.launched, int(number) if number.isdigit() else 0)
        member = Member(name=name, launched_s=now_s, health=Health(started_s=-math.inf), adopted=True)
        self.members[name] = member
        if is_target:
            self._still_targets.add(name)
        return member

    async def bring_up(self, member: Member, timeout_s: float) -> None:
        """Wait until robots are sent to *member*.

        Raises:
            ConfigurationError: It ended, did not announce itself, or the balancer found it unhealthy.
        """
        try:
            server = await self._backend_servers.wait_ready(member.name, timeout_s)
        except ConfigurationError:
            self._backend_servers.send(member.name, signal.SIGKILL)
            code = await self._backend_servers.wait_over(member.name)
            self._forget(member)
            self._emit_gone(member.name, None, code)
            raise
        end = time.monotonic() + timeout_s
        member.server = server
        self._still_targets.discard(member.name)
        self._set_targets()
        self.keep(self._watch(member, server))
        self._emit("server-ready", server=member.name, pid=server.pid, port=server.port)
        self.on_ready(member)
        while not member.over.is_set() and not member.leaving and not member.out:
            left_s = min(end - time.monotonic(), _LOOK_UP_S)
            if await self._load_balancer.wait_healthy([member.name], max(left_s, 0.0)):
                self._note_healthy(member, server)
                return
            if time.monotonic() >= end:
                raise ConfigurationError(
                    f"the load balancer found {member.name} unhealthy", hint=f"its log is {server.log}"
                )
            await asyncio.sleep(_PAUSE_S)  # the balancer itself may be restarting

    def start_standby(self) -> None:
        """Start a standby for the next launch, unless a server started less than 3 s ago."""
        calm_since_s = time.monotonic() - self._calm_s
        ready = (member.healthy_s for member in self.members.values())
        standby = self._backend_servers.standby
        if all(at is not None and at <= calm_since_s for at in ready) and standby.warm():
            self._emit("standby-started", pid=standby.pid)

    def start(self, member: Member) -> None:
        """Bring *member* up in the background; its failure is an event and a loss."""
        self.keep(self._start(member))

    async def wait_until_healthy(self, members: Iterable[Member], timeout_s: float) -> None:
        """Wait until robots are sent to all of *members*; raises ConfigurationError if that fails."""
        for member in members:
            either = [asyncio.ensure_future(event.wait()) for event in (member.healthy, member.over)]
            try:
                await asyncio.wait(either, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for waiting in either:
                    waiting.cancel()
            if not member.healthy.is_set():
                raise ConfigurationError(
                    f"{member.name} did not become healthy", hint=f"look at the log {member.name}.log"
                )

    # --- what the scale modifier does ------------------------------------------------------------

    def standing(self, now_s: float) -> ServerHealth:
        """Return the servers as the policy counts them."""
        there = [member for member in self.members.values() if not member.leaving and not member.out]
        return ServerHealth(
            servers=len(there) + len(self.dead),
            warming=sum(self.is_warming(member, now_s) for member in there),
            healthy=sum(member.phase == "healthy" for member in there),
            replacing=sum(member.replaces_living and member.phase == "starting" for member in there),
            broken=tuple(
                member.name for member in there if member.phase == "unhealthy" and not member.on_trial
            ),
            dead=dict(self.dead),
        )

    def grow(self, count: int, reason: str, *, on_trial: bool = False) -> Sequence[str]:
        """Launch *count* servers at once; return their names."""
        members = [self.launch() for _ in range(count)]
        for member in members:
            member.on_trial = on_trial
            self.start(member)
        return [member.name for member in members]

    def shrink(self, reason: str) -> str | None:
        """Begin to drain the healthy server with the fewest robots; return its name."""
        healthy = [member for member in self.members.values() if member.phase == "healthy"]
        if len(healthy) < 2:
            return None
        least = min(healthy, key=lambda member: (member.robots, -member.launched_s))
        self.begin_drain(least, reason)
        self.keep(self.finish_drain(least, time.monotonic()))
        return least.name

    def launch_replacement(self, name: str, reason: str) -> str:
        """Launch a server in place of *name*; one that lives is cut off so that its robots go elsewhere.

        One that leaves in order already is left alone.
        """
        self.dead.pop(name, None)
        member = self.members.get(name)
        cut_off = member is not None and not member.leaving
        if member is not None and cut_off:
            member.out = True
            self._set_targets()
        new = self.launch(replaces_living=cut_off)
        if cut_off:
            self._backend_servers.send(name, signal.SIGKILL)
        self.start(new)
        return new.name

    def withdraw(self, name: str) -> None:
        """End the new server *name*, which did not become healthy; it is not replaced."""
        member = self.members.get(name)
        if member is not None:
            member.out = True
            self._set_targets()
            self._backend_servers.send(name, signal.SIGKILL)

    # --- drain -----------------------------------------------------------------------------------

    def begin_drain(self, member: Member, reason: str) -> None:
        """Send *member* no new robots."""
        member.leaving = True
        self._set_targets()
        self._emit("drain-start", server=member.name, reason=reason)

    async def finish_drain(self, member: Member, began_s: float) -> dict[str, Any]:
        """Wait until the balancer has dropped it, let it move its robots, and wait until it has left."""
        session = self.settings.session
        notice_s = time_to_notice_s(self.settings.health, local=True)
        if await self._load_balancer.wait_gone(member.name, STOP_TIMEOUT_S):
            self._emit("server-out", server=member.name)
        server = member.server
        reply = None
        if server is not None:
            port = self.control(server)
            reply = await port.ask_once("/drain?wait=0", timeout_s=_DRAIN_REQUEST_S, method="POST")
        accepted = reply is not None and reply.status == 202
        drain_s = MOVE_WITHIN_MS / 1e3 + session.answer_timeout_s + STOP_TIMEOUT_S
        clean = True
        try:
            await asyncio.wait_for(member.over.wait(), drain_s if accepted else notice_s)
        except asyncio.TimeoutError:
            clean = False
            self._backend_servers.send(member.name, signal.SIGKILL)
            await member.over.wait()
        report = {
            "server": member.name, "seconds": round(time.monotonic() - began_s, 3),
            "clean": accepted and clean,
        }  # fmt: skip
        self._emit("drain-over", **report)
        return report

    def note_own_drain(self, member: Member) -> None:
        """Note that *member* drains although this control plane did not ask: it is replaced.

        An adopted server is not: the earlier control plane that asked it wanted one server less.
        """
        if not member.leaving:
            self.begin_drain(member, "the server drains on another request")
            if not member.adopted:
                self.dead[member.name] = False
                self.on_lost()

    def keep(self, work: Coroutine[Any, Any, Any]) -> None:
        """Let *work* go on until it is done or the platform ends."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._finish_task)

    async def close(self) -> None:
        """End everything that still waits; no process is touched.

        Cancels until none is left: `asyncio.wait_for` before Python 3.12 loses a cancellation that comes
        together with the result.
        """
        while self._tasks:
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks, timeout=_CANCEL_AGAIN_S)

    # --- helpers ---------------------------------------------------------------------------------

    async def _start(self, member: Member) -> None:
        try:
            await self.bring_up(member, self.settings.local.start_timeout_s)
        except ConfigurationError as error:
            self._emit("server-failed", server=member.name, reason=error.message)
            if member.server is not None:  # announced, but never healthy: `_watch` handles its end
                self._backend_servers.send(member.name, signal.SIGKILL)
            elif not member.out and not member.leaving:
                self._note_lost(member)

    def _note_healthy(self, member: Member, server: BackendServer) -> None:
        """Note that the balancer found *member* healthy, by the same rule as `observe`."""
        member.healthy_s = time.monotonic()
        if member.health.state == "starting":
            member.health = dataclasses.replace(member.health, state="healthy")
        member.replaces_living = member.on_trial = False
        member.healthy.set()
        self._emit("server-healthy", server=member.name, pid=server.pid)
        self.on_healthy()

    async def _watch(self, member: Member, server: BackendServer) -> None:
        """Wait for the end of a server, and remove it from the targets and the members."""
        code = await self._backend_servers.wait_over(server.name)
        unasked = not member.leaving and not member.out
        self._forget(member)
        self._set_targets()
        self._emit_gone(server.name, server.pid, code)
        if unasked:
            self._note_lost(member)
        if not member.leaving and await self._load_balancer.wait_gone(server.name, STOP_TIMEOUT_S):
            self._emit("server-out", server=server.name)

    def _emit_gone(self, name: str, pid: int | None, exit_code: int | None) -> None:
        cause = "; the disk is full" if exit_code and self.is_full() else ""
        self._emit("server-gone", server=name, pid=pid, exit_code=exit_code, cause=cause)

    def _forget(self, member: Member) -> None:
        self._backend_servers.forget(member.name)
        self._still_targets.discard(member.name)
        self.members.pop(member.name, None)
        member.over.set()
        self._changed()

    def _note_lost(self, member: Member) -> None:
        if member.on_trial:
            return
        early_since_s = time.monotonic() - _MIN_UPTIME_S
        ended_early = member.healthy_s is None or member.healthy_s > early_since_s
        self.dead[member.name] = ended_early and not self.is_full()  # a full disk is no crash loop
        self.on_lost()

    def _set_targets(self) -> None:
        if not self._still_targets:
            self._load_balancer.set_targets([server.target for server in self.serving])
        self._changed()

    def _finish_task(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            task.get_loop().call_exception_handler(
                {
                    "message": "a task of the local platform failed",
                    "exception": task.exception(),
                    "task": task,
                }
            )
