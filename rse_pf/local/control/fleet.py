"""The backend servers of one local platform, each from its launch until its process has exited.

The fleet decides which servers may get robots, emits every change as an event, and carries out the launches,
drains and replacements that the scale modifier and operations decide.  A server is removed from the load
balancer's targets before it is asked to drain, and no two servers of a platform get the same name.
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

# Time limit of the request that asks a server to drain, in seconds.
_DRAIN_REQUEST_S = 2.0
# Longest wait until the load balancer finds a new server healthy, in seconds; then it is looked at again
# whether that server has exited or leaves, and the wait begins again.
_HEALTHY_WAIT_S = 0.5
# Pause between two waits until the load balancer finds a new server healthy, in seconds: while the load
# balancer is being restarted, a wait returns at once.
_PAUSE_S = 0.02
# When the fleet is closed, background tasks that still run after this time are cancelled again, in seconds.
_CANCEL_AGAIN_S = 0.2
# A warm standby starts once every server has been healthy for this long, in seconds, so that its imports do
# not delay the start of a server.
_CALM_S = 3.0
_PREFIX = "server-"
# A server that exits less than this after it became healthy, in seconds, or before that, has ended early:
# such replacements are limited by `MAX_RESTARTS_PER_MINUTE`.
_MIN_UPTIME_S = 10.0


@dataclass(slots=True, kw_only=True)
class Member:
    """One backend server, from its launch until its process has exited.

    ``server`` is None until the process has announced itself.  ``leaving``: it drains.  ``out``: another
    server replaces it, and it is killed.  ``on_trial``: a roll started it, and nothing replaces it before it
    was healthy once.  ``replaces_living``: it replaces a server whose process still ran, and is not healthy
    yet.  ``adopted``: an earlier control plane launched it.  ``robots`` and ``observed`` are from the last
    sample.

    The events ``healthy`` and ``over`` are set when it becomes healthy and when its process has exited.
    ``launched_s`` and ``healthy_s`` are monotonic seconds; those of ``health`` run faster by ``compress``.
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
        """The state of this server, as samples of the monitor name it."""
        if self.leaving:
            return "draining"
        if self.out or self.health.state == "unhealthy":
            return "unhealthy"
        return "healthy" if self.healthy_s is not None and self.health.state == "healthy" else "starting"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerHealth:
    """Numbers and names of servers by state.

    ``servers`` counts all servers that exist or should: those that start, serve, fail their checks or exited
    unexpectedly, but not those that drain.  ``warming`` counts servers whose CPU time does not count yet.
    ``broken`` names servers that run but fail their checks.  ``dead`` maps the name of each server that has
    exited to whether it did so soon after its start.  ``replacing`` counts servers that start in place of one
    that still ran.
    """

    servers: int
    warming: int = 0
    healthy: int = 0
    replacing: int = 0
    broken: tuple[str, ...] = ()
    dead: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class FleetReports:
    """Callbacks of the platform.

    ``emit(event, **details)`` reports an event; ``changed()`` writes the state file.
    """

    emit: Callable[..., None]
    changed: Callable[[], None]


class Fleet:
    """The backend servers of one platform.

    ``members`` has the servers whose processes run or start, by name; ``dead`` those that exited and are not
    replaced yet, with whether each ended early; ``launched`` is the highest number of a server's name.
    """

    def __init__(
        self,
        backend_servers: LocalBackendServers,
        load_balancer: EnvoyLoadBalancer,
        settings: PlatformSettings,
        *,
        compress: float,
        reports: FleetReports,
    ) -> None:
        """Make a fleet without servers; *compress* divides the warm-up time and the wait for a standby."""
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
        """Return whether the disk is full; then no server is launched, since it could not announce itself."""
        self._tasks: set[asyncio.Task[Any]] = set()
        self._still_targets: set[str] = set()
        self.on_ready: Callable[[Member], None] = lambda member: None
        """Called with each server that has announced itself."""
        self.on_healthy: Callable[[], None] = lambda: None
        """Called when the load balancer begins to send robots to a server."""
        self.on_lost: Callable[[], None] = lambda: None
        """Called when a server has to be replaced because it exited or drains unasked."""

    @property
    def serving(self) -> tuple[BackendServer, ...]:
        """The servers that may get robots: announced, not exited, and neither draining nor replaced."""
        return tuple(
            member.server
            for member in self.members.values()
            if member.server is not None and not member.leaving and not member.out
        )

    def member(self, name: str) -> Member:
        """Return the server called *name*; raises UsageError if none is running."""
        if name not in self.members:
            running = ", ".join(self.members) or "none"
            raise UsageError(f"no server named {name!r} is running", hint=f"running are {running}")
        return self.members[name]

    def control(self, server: BackendServer) -> ControlPort:
        """Return a client of the control port of *server*."""
        return self._backend_servers.control(server.control_port)

    def is_warming(self, member: Member, now_s: float) -> bool:
        """Return whether *member* is in its warm-up, in which its CPU time does not count for scaling.

        The warm-up lasts until ``scaling.warm_up_s`` (compressed) after the server became healthy; an adopted
        server has none.
        """
        if member.adopted:
            return False
        return member.healthy_s is None or now_s - member.healthy_s < self._warm_up_s

    # --- start of a server: from the launch until the balancer sends it robots --------------------

    def launch(self, *, replaces_living: bool = False) -> Member:
        """Start the process of a new server, and return before it listens.

        The caller must call `start` or `bring_up` with the server that is returned.
        """
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
        """Take over the server *name* of an earlier control plane; the caller must `start` it.

        Its failed health checks count at once, without the grace period of a new server.  The targets of the
        load balancer stay unchanged until every adopted server that *is_target* of the balancer now has been
        brought up.
        """
        number = name.removeprefix(_PREFIX)
        self.launched = max(self.launched, int(number) if number.isdigit() else 0)
        member = Member(name=name, launched_s=now_s, health=Health(started_s=-math.inf), adopted=True)
        self.members[name] = member
        if is_target:
            self._still_targets.add(name)
        return member

    async def bring_up(self, member: Member, timeout_s: float) -> None:
        """Wait until *member* has announced itself, make it a target, and wait until robots are sent to it.

        Each of the two waits takes *timeout_s* at most.  Returns early, without an error, if the server
        leaves, is replaced or exits after its announcement.

        Raises:
            ConfigurationError: The server exited or did not announce itself, and was killed; or the load
                balancer did not find it healthy in time.
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
            left_s = min(end - time.monotonic(), _HEALTHY_WAIT_S)
            if await self._load_balancer.wait_healthy([member.name], max(left_s, 0.0)):
                self._note_healthy(member, server)
                return
            if time.monotonic() >= end:
                raise ConfigurationError(
                    f"the load balancer found {member.name} unhealthy", hint=f"read its log {server.log}"
                )
            await asyncio.sleep(_PAUSE_S)  # the balancer itself may be restarting

    def start_standby(self) -> None:
        """Start a warm standby for the next launch if there is none, once no server starts or just started.

        Every server must have been healthy for 3 s (compressed).
        """
        calm_since_s = time.monotonic() - self._calm_s
        ready = (member.healthy_s for member in self.members.values())
        standby = self._backend_servers.standby
        if all(at is not None and at <= calm_since_s for at in ready) and standby.warm():
            self._emit("standby-started", pid=standby.pid)

    def start(self, member: Member) -> None:
        """Bring *member* up in the background; if that fails, emit ``server-failed`` and count it as lost."""
        self.keep(self._start(member))

    async def wait_until_healthy(self, members: Iterable[Member], timeout_s: float) -> None:
        """Wait until robots are sent to all of *members*, at most *timeout_s* for each.

        Raises:
            ConfigurationError: A server exited, or did not become healthy in time.
        """
        for member in members:
            either = [asyncio.ensure_future(event.wait()) for event in (member.healthy, member.over)]
            try:
                await asyncio.wait(either, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for waiting in either:
                    waiting.cancel()
            if not member.healthy.is_set():
                raise ConfigurationError(
                    f"{member.name} did not become healthy", hint=f"read its log {member.name}.log"
                )

    # --- launches, drains and replacements that the scale modifier and operations decide ----------

    def standing(self, now_s: float) -> ServerHealth:
        """Return the numbers of servers in each state at *now_s* (monotonic), for the scaling policy."""
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

    def grow(self, count: int, *, on_trial: bool = False) -> Sequence[str]:
        """Launch *count* servers and return their names at once.

        With *on_trial*, a server that never becomes healthy is not replaced.
        """
        members = [self.launch() for _ in range(count)]
        for member in members:
            member.on_trial = on_trial
            self.start(member)
        return [member.name for member in members]

    def shrink(self, reason: str) -> str | None:
        """Begin to drain the healthy server with the fewest robots; return its name.

        Of servers with equally few robots, the one that was launched last.  None, and nothing happens, if
        fewer than two servers are healthy.
        """
        healthy = [member for member in self.members.values() if member.phase == "healthy"]
        if len(healthy) < 2:
            return None
        least = min(healthy, key=lambda member: (member.robots, -member.launched_s))
        self.begin_drain(least, reason)
        self.keep(self.finish_drain(least, time.monotonic()))
        return least.name

    def launch_replacement(self, name: str) -> str:
        """Launch a server in place of *name*, and return the new name.

        If *name* still runs, it gets no new robots and is killed, so that its robots connect to other
        servers.  If it drains already, its drain goes on.
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
        """Kill the new server *name*, which did not become healthy; no server replaces it."""
        member = self.members.get(name)
        if member is not None:
            member.out = True
            self._set_targets()
            self._backend_servers.send(name, signal.SIGKILL)

    # --- the drain of one server ------------------------------------------------------------------

    def begin_drain(self, member: Member, reason: str) -> None:
        """Remove *member* from the load balancer's targets, and emit ``drain-start`` with *reason*."""
        member.leaving = True
        self._set_targets()
        self._emit("drain-start", server=member.name, reason=reason)

    async def finish_drain(self, member: Member, began_s: float) -> dict[str, Any]:
        """Ask *member* to drain once the load balancer has removed it, wait until it has exited, and report.

        A server that refuses to drain or takes too long is killed.  The report, also emitted as
        ``drain-over``, has the name, the seconds since *began_s* (monotonic), and ``clean``: whether it
        drained by itself.
        """
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
        """Note that *member* drains although this control plane did not ask it to, and have it replaced.

        An adopted server is not replaced: the earlier control plane asked it to drain, to have one server
        less.
        """
        if not member.leaving:
            self.begin_drain(member, "the server drains on another request")
            if not member.adopted:
                self.dead[member.name] = False
                self.on_lost()

    def keep(self, work: Coroutine[Any, Any, Any]) -> None:
        """Run *work* as a task in the background, until it is done or `close` cancels it."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._finish_task)

    async def close(self) -> None:
        """Cancel all background tasks and wait until none is left; no process is signalled.

        Tasks are cancelled again and again: `asyncio.wait_for` before Python 3.12 loses a cancellation that
        comes together with the result.
        """
        while self._tasks:
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks, timeout=_CANCEL_AGAIN_S)

    # --- changes of one server's state ------------------------------------------------------------

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
        """Note that the load balancer found *member* healthy; its checks use the same limits as `observe`."""
        member.healthy_s = time.monotonic()
        if member.health.state == "starting":
            member.health = dataclasses.replace(member.health, state="healthy")
        member.replaces_living = member.on_trial = False
        member.healthy.set()
        self._emit("server-healthy", server=member.name, pid=server.pid)
        self.on_healthy()

    async def _watch(self, member: Member, server: BackendServer) -> None:
        """Wait until a server has exited, remove it from targets and members, and emit ``server-gone``.

        If it neither drained nor was replaced, it counts as lost.
        """
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
        """Remove *member*, whose process has exited, from the fleet, and set its event ``over``."""
        self._backend_servers.forget(member.name)
        self._still_targets.discard(member.name)
        self.members.pop(member.name, None)
        member.over.set()
        self._changed()

    def _note_lost(self, member: Member) -> None:
        """Have *member*, which exited, replaced, unless it is on trial."""
        if member.on_trial:
            return
        early_since_s = time.monotonic() - _MIN_UPTIME_S
        ended_early = member.healthy_s is None or member.healthy_s > early_since_s
        self.dead[member.name] = ended_early and not self.is_full()  # a full disk is no crash loop
        self.on_lost()

    def _set_targets(self) -> None:
        """Make the serving servers the balancer's targets, but not before all adopted targets are up."""
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
