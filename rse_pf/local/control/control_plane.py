"""The control plane of a local platform: monitor the servers, decide, act.

Health checks, samples of the monitor, the scale modifier, the rebalancing of robots and the restart of a lost
load balancer run here, in one event loop without threads.  While the control plane does not run, servers and
load balancer still serve robots.  A health check that the control plane itself delayed is not counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from rse_pf.config import PlatformSettings, ScalingSettings
from rse_pf.config.resource_names import READY_PATH
from rse_pf.config.schedule import minimum_at, parse_schedule, zone_named
from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.local.control.fleet import Fleet, FleetReports, Member
from rse_pf.local.control.monitor import (
    MonitorSample,
    Observed,
    Periods,
    ServerSample,
    capacity_cores,
    monitor_sample,
    sample_interval_s,
    server_sample,
)
from rse_pf.local.control.rebalancer import Rebalancer
from rse_pf.local.control.scale_modifier import LocalScaleModifier
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.scaling.health import LOCAL_INTERVAL_S, LOCAL_TIMEOUT_S, observe
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rebalance import MoveOrder

__all__ = ["ControlOptions", "ControlPlane"]

# While this many replacements of any server were started within the last 60 s, a server that exited soon
# after its start is not replaced: a release that cannot start (a crash loop) would otherwise take all the CPU
# time.
MAX_RESTARTS_PER_MINUTE = 5
# Time limit of the request that asks a server to move robots, in seconds.
_MOVE_TIMEOUT_S = 2.0
# Time limit of reading a server's /status page, as a share of the time between two samples: a slow server
# must not delay the next sample.
_STATUS_SHARE = 0.5
# A failed health check that took more than (1 + this) times its time limit was delayed by the control plane
# itself, and does not count.
_LATE_SHARE = 0.5
# States in which a server answers /readyz with a failure because it drains, and not because it is unhealthy.
_LEAVING = frozenset({"draining", "leaving"})
# Longest pause between two attempts to start the load balancer, in seconds; each pause doubles the one
# before.
_MAX_PAUSE_S = 8.0
# Time between two checks whether a warm standby process is missing, in seconds.
_STANDBY_EVERY_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlOptions:
    """The automatic actions of a control plane.

    With ``elastic``, servers are started and drained by load, and servers and a load balancer that fail are
    replaced; with ``elastic`` and ``rebalance``, robots of crowded servers are asked to move.  ``compress``
    is the factor by which the periods of the monitor and the idle, warm-up and grace times are shortened, for
    experiments.  ``on_sample`` is called with each sample of the monitor; with it the monitor runs also if
    ``elastic`` is False.
    """

    elastic: bool = False
    rebalance: bool = True
    compress: float = 1.0
    on_sample: Callable[[Mapping[str, Any]], None] | None = None


class ControlPlane:
    """The loops that observe one `Fleet` and its load balancer, decide, and act.

    ``sample`` is the newest sample of the monitor, None before the first.  While ``hold`` is True, servers
    are only replaced: an operation of the operator changes their number.
    """

    def __init__(
        self,
        fleet: Fleet,
        load_balancer: EnvoyLoadBalancer,
        settings: PlatformSettings,
        scaling: ScalingSettings,
        options: ControlOptions,
        reports: FleetReports,
    ) -> None:
        self.sample: MonitorSample | None = None
        self.hold = False
        cadence = cadence_of(scaling)
        self.modifier = LocalScaleModifier(
            fleet,
            scaling,
            max_restarts_per_minute=MAX_RESTARTS_PER_MINUTE,
            compress=options.compress,
            minimum=_scheduled_minimum(scaling),
            emit=reports.emit,
        )
        self._fleet = fleet
        self._load_balancer = load_balancer
        self.settings = settings
        self._elastic = options.elastic
        self._compress = options.compress
        self._is_idle = not options.elastic and options.on_sample is None
        self._emit = reports.emit
        self._changed = reports.changed
        self._on_sample = options.on_sample
        period_s = cadence.period_s / options.compress
        self._every_s = sample_interval_s(period_s)
        self._period_s = period_s
        self._seen_periods = math.inf
        self._periods = Periods(period_s, keep=cadence.most + 2)
        self._rebalancer = Rebalancer() if options.elastic and options.rebalance else None
        self._ports: dict[str, ControlPort] = {}
        self._cores = len(os.sched_getaffinity(0))

    def start_checks(self) -> None:
        """Check the health of every server from its announcement on, if elastic or with ``on_sample``."""
        if self._is_idle:
            return
        self._fleet.on_ready = lambda member: self._fleet.keep(self._check_periodically(member))

    def start(self) -> None:
        """Start the monitor; if elastic, also the scale modifier and the watches of balancer and standby.

        Nothing starts if the options ask for neither elastic operation nor samples.
        """
        if self._is_idle:
            return
        self._fleet.on_healthy = self.watch_spread
        self._fleet.keep(self._monitor())
        if self._elastic:
            self._fleet.on_lost = self._act_soon
            self._fleet.keep(self._watch_balancer())
            self._fleet.keep(self._keep_standby())
            self._act_soon()

    async def _keep_standby(self) -> None:
        """Start a warm standby whenever there is none and no server became healthy in the last 3 s."""
        while self._elastic:
            await asyncio.sleep(_STANDBY_EVERY_S)
            self._fleet.start_standby()

    def stop(self) -> None:
        """Start, drain and replace no server from now on; the monitor still takes samples."""
        self._elastic = False

    def retry_replacements(self) -> None:
        """Run the scale modifier again soon: replacements may have waited for space on a full disk."""
        self._act_soon()

    def watch_spread(self) -> None:
        """For 30 s, ask robots of crowded servers to move; do nothing unless rebalancing is on."""
        if self._rebalancer is not None:
            self._rebalancer.watch(time.monotonic())

    def document(self) -> dict[str, Any]:
        """Return the state of the scaling policy, and its samples, one a period, as plain JSON values."""
        samples = [
            {"start_s": sample.start_s, "cpu_percent": sample.cpu_percent, "requests": sample.requests}
            for sample in self._periods.samples(time.monotonic())
        ]
        return {**self.modifier.document(), "elastic": self._elastic, "samples": samples}

    # --- periodic health checks of the servers ----------------------------------------------------

    async def _check_periodically(self, member: Member) -> None:
        """Check */readyz* of *member* every `LOCAL_INTERVAL_S` until it leaves, is replaced or has exited."""
        assert member.server is not None
        port = self._fleet.control(member.server)
        try:
            while not (member.over.is_set() or member.leaving or member.out):
                began_s = time.monotonic()
                ok = await self._check(member, port, began_s)
                if ok is not None:
                    self._note_check(member, ok)
                left_s = began_s + LOCAL_INTERVAL_S - time.monotonic()
                await asyncio.sleep(max(left_s, 0.0))
        finally:
            port.close()

    async def _check(self, member: Member, port: ControlPort, began_s: float) -> bool | None:
        """Return whether */readyz* answered 200 in time; None if the check does not count.

        A check does not count if this process was late itself, or if the server drains: then its drain is
        noted.
        """
        try:
            reply = await port.ask(READY_PATH, timeout_s=LOCAL_TIMEOUT_S)
        except ConnectionError:
            late_s = time.monotonic() - began_s - LOCAL_TIMEOUT_S
            return None if late_s > _LATE_SHARE * LOCAL_TIMEOUT_S else False
        if reply.status != 200 and reply.document().get("state") in _LEAVING:
            self._fleet.note_own_drain(member)
            return None
        return reply.status == 200

    def _note_check(self, member: Member, ok: bool) -> None:
        """Update the health of *member* with one check; emit an event and act if it became unhealthy.

        The times of `Health` run faster by the factor ``compress``, which shortens the grace period.
        """
        health = member.health
        now_s = time.monotonic() * self._compress
        member.health = observe(health, ok, self.settings.health, now_s=now_s)
        if member.health.state == "unhealthy" and health.state != "unhealthy":
            failed = self.settings.health.unhealthy_checks
            self._emit("server-unhealthy", server=member.name, reason=f"{failed} checks in a row failed")
            self._act_soon()

    # --- samples of the monitor -------------------------------------------------------------------

    async def _monitor(self) -> None:
        """Take a sample at each whole multiple of the sample interval on the monotonic clock."""
        try:
            while True:
                now_s = time.monotonic()
                await asyncio.sleep((math.floor(now_s / self._every_s) + 1) * self._every_s - now_s)
                self._take(await self._sample_all())
        finally:
            for port in self._ports.values():
                port.close()

    def _take(self, sample: MonitorSample) -> None:
        self.sample = sample
        if self._on_sample is not None:
            self._on_sample(sample.document())
        self._periods.add(sample)
        seen_periods = math.floor(sample.time / self._period_s)
        self._act(period_over=seen_periods > self._seen_periods)
        self._seen_periods = seen_periods
        self._rebalance(sample)

    async def _sample_all(self) -> MonitorSample:
        members = list(self._fleet.members.values())
        stats, servers = await asyncio.gather(
            self._load_balancer.stats(), asyncio.gather(*(self._sample(member) for member in members))
        )
        there = set(self._fleet.members)
        for gone in set(self._ports) - there:
            self._ports.pop(gone).close()
        in_balancer = frozenset(name for name, target in stats.items() if target.healthy)
        return monitor_sample(
            time.monotonic(), [server for server in servers if server.name in there], in_balancer
        )

    async def _sample(self, member: Member) -> ServerSample:
        server = member.server
        observed = None
        if server is not None:
            if member.name not in self._ports:
                self._ports[member.name] = self._fleet.control(server)
            # A server that does not answer has no numbers; `_check_periodically` decides about its health.
            with contextlib.suppress(ConnectionError):
                timeout_s = _STATUS_SHARE * self._every_s
                reply = await self._ports[member.name].ask("/status", timeout_s=timeout_s)
                if reply.status == 200 and "cpu_s" in reply.document():
                    observed = Observed(at_s=time.monotonic(), status=reply.document())
        workers = 1 if server is None else len(server.workers)
        silent = ServerSample(
            name=member.name,
            pid=0 if server is None else server.pid,
            state=member.phase,
            warming=self._fleet.is_warming(member, time.monotonic()),
        )
        sample = server_sample(
            silent,
            member.observed,
            observed,
            capacity=capacity_cores(self.settings.serving, workers, self._cores),
        )
        if observed is not None:
            member.observed = observed
            member.robots = sample.robots
        return sample

    # --- actions of the scale modifier and the rebalancer -----------------------------------------

    def _act_soon(self) -> None:
        if self._elastic:
            asyncio.get_running_loop().call_soon(self._act)

    def _act(self, period_over: bool = False) -> None:
        if self._elastic:
            now_s = time.monotonic()
            samples = self._periods.samples(now_s)
            self.modifier.act(samples, now_s=now_s, period_over=period_over, hold=self.hold)

    def _rebalance(self, sample: MonitorSample) -> None:
        if self._rebalancer is None or self.hold:
            return
        robots = {server.name: server.robots for server in sample.servers if server.state == "healthy"}
        for name, order in self._rebalancer.plan_orders(robots, sample.time).items():
            self._fleet.keep(self._move(name, order))

    async def _move(self, name: str, order: MoveOrder) -> None:
        """Ask a server to move robots, and emit ``rebalance`` if it asks any to move."""
        member = self._fleet.members.get(name)
        if member is None or member.server is None:
            return
        target = f"/move?robots={order.robots}&spread_s={order.spread_s:g}"
        port = self._fleet.control(member.server)
        reply = await port.ask_once(target, timeout_s=_MOVE_TIMEOUT_S, method="POST")
        if reply is None or reply.status >= 300:
            return  # a later sample leads to another order
        answer = reply.document()
        if answer.get("robots"):
            self._emit("rebalance", server=name, robots=answer["robots"], spread_s=answer["spread_s"])

    # --- restart of a lost load balancer ----------------------------------------------------------

    async def _watch_balancer(self) -> None:
        """Start the load balancer again, on its port, whenever it has exited."""
        while True:
            why = await self._load_balancer.wait_over()
            began_s = time.monotonic()
            mark = self._load_balancer.process.mark
            self._emit("balancer-gone", pid=None if mark is None else mark.pid, reason=why)
            await self._restart_balancer()
            seconds = round(time.monotonic() - began_s, 3)
            self._changed()
            mark = self._load_balancer.process.mark
            self._emit("balancer-back", seconds=seconds, pid=None if mark is None else mark.pid)
            self.watch_spread()

    async def _restart_balancer(self) -> None:
        """Try to start the load balancer until it listens, with growing pauses."""
        pause_s = LOCAL_INTERVAL_S
        while True:
            try:
                self._load_balancer.launch()
                await self._load_balancer.wait_live(self.settings.local.start_timeout_s)
                return
            except ConfigurationError as error:
                self._emit("balancer-failed", reason=error.message, wait_s=pause_s)
            await asyncio.sleep(pause_s)
            # While the disk is full the pause stays short, so that a start follows as soon as there is space.
            pause_s = LOCAL_INTERVAL_S if self._fleet.is_full() else min(2 * pause_s, _MAX_PAUSE_S)


def _scheduled_minimum(scaling: ScalingSettings) -> Callable[[], int] | None:
    """Return a function that gives the scheduled ``min_servers`` of now; None if there is no schedule.

    The times of day are those of ``scaling.time_zone``; where no entry of the schedule applies, the function
    returns ``scaling.min_servers``.
    """
    entries, zone = parse_schedule(scaling.schedule), zone_named(scaling.time_zone)
    if not entries:
        return None
    return lambda: minimum_at(entries, datetime.now(zone), otherwise=scaling.min_servers)
