"""The control plane of a local platform: look at the servers, decide, act; the loop around the boxes.

Health checks, readings, the scale modifier, the hand-over of robots and the return of a lost balancer run
here, in one event loop and without threads of their own.  Promises that robots are served on when it is gone,
and that its own lateness is never held against a server.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from rse_pf.config import PlatformSettings, ScalingSettings
from rse_pf.config.resource_names import READY_PATH
from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.local.control.fleet import Fleet, Member
from rse_pf.local.control.monitor import (
    MonitorSample,
    Observed,
    Periods,
    ServerReading,
    capacity_cores,
    reading_every_s,
    reading_of,
    server_reading,
)
from rse_pf.local.control.rebalancer import Order, Rebalancer
from rse_pf.local.control.scale_modifier import LocalScaleModifier
from rse_pf.local.servers.control_client import ControlPort, ControlPortReply
from rse_pf.scaling.health import LOCAL_INTERVAL_S, LOCAL_TIMEOUT_S, observe

__all__ = ["ControlPlane"]

_ASK_S = 2.0
_STATUS_SHARE = 0.5
_LATE_SHARE = 0.5
"""A check whose deadline was noticed later than this share of it says more about us than about the server."""
_LEAVING = frozenset({"draining", "leaving"})
_MAX_PAUSE_S = 8.0
_SPARE_EVERY_S = 1.0


class ControlPlane:
    """Monitor and scale modifier over one `Fleet`."""

    def __init__(
        self,
        fleet: Fleet,
        load_balancer: EnvoyLoadBalancer,
        settings: PlatformSettings,
        scaling: ScalingSettings,
        *,
        elastic: bool,
        compress: float,
        rebalance: bool,
        tell: Callable[..., None],
        changed: Callable[[], None],
        on_reading: Callable[[Mapping[str, Any]], None] | None,
    ) -> None:
        self.reading: MonitorSample | None = None
        self.hold = False
        self.modifier = LocalScaleModifier(
            fleet,
            scaling,
            max_restarts_per_minute=settings.local.max_restarts_per_minute,
            compress=compress,
            tell=tell,
        )
        self._fleet = fleet
        self._load_balancer = load_balancer
        self._settings = settings
        self._elastic = elastic
        self._compress = compress
        self._tell = tell
        self._changed = changed
        self._on_reading = on_reading
        period_s = scaling.period_s / compress
        self._every_s = reading_every_s(period_s)
        self._periods = Periods(period_s, keep=scaling.idle_s // scaling.period_s + scaling.busy_periods + 1)
        self._rebalancer = Rebalancer(scaling) if elastic and rebalance else None
        self._before: dict[str, Observed] = {}
        self._ports: dict[str, ControlPort] = {}
        self._cores = len(os.sched_getaffinity(0))

    def attend(self) -> None:
        """Check the health of every server from its announcement on."""
        self._fleet.on_ready = lambda member: self._fleet.keep(self._check_on(member))

    def start(self) -> None:
        """Begin to read, and to decide if elastic."""
        self._fleet.on_healthy = self.watch_spread
        self._fleet.keep(self._read_on())
        if self._elastic:
            self._fleet.on_lost = self._soon
            self._fleet.keep(self._keep_balancer())
            self._fleet.keep(self._keep_spare())
            self._soon()

    async def _keep_spare(self) -> None:
        """After every launch, once all is calm, prepare the next one."""
        while self._elastic:
            await asyncio.sleep(_SPARE_EVERY_S)
            self._fleet.warm_spare()

    def stop(self) -> None:
        """Act no more, whatever was about to happen."""
        self._elastic = False

    def watch_spread(self) -> None:
        """Look whether robots are spread evenly, for a while."""
        if self._rebalancer is not None:
            self._rebalancer.watch(time.monotonic())

    def document(self) -> dict[str, Any]:
        """Return the state of the policy as plain JSON values."""
        samples = self._periods.samples(time.monotonic())
        told = [
            {"start_s": sample.start_s, "cpu_percent": sample.cpu_percent, "requests": sample.requests}
            for sample in samples
        ]
        return {**self.modifier.document(), "elastic": self._elastic, "samples": told}

    # --- health ----------------------------------------------------------------------------------

    async def _check_on(self, member: Member) -> None:
        """Ask */readyz* of one server again and again, as the balancer does."""
        assert member.server is not None
        port = self._fleet.control(member.server)
        try:
            while not (member.over.is_set() or member.leaving or member.out):
                began_s = time.monotonic()
                ok = await self._check(member, port, began_s)
                if ok is not None:
                    self._judge(member, ok)
                left_s = began_s + LOCAL_INTERVAL_S - time.monotonic()
                await asyncio.sleep(max(left_s, 0.0))
        finally:
            port.close()

    async def _check(self, member: Member, port: ControlPort, began_s: float) -> bool | None:
        """Return the outcome of one check; None if it tells nothing about the server."""
        timeout_s = LOCAL_TIMEOUT_S
        try:
            reply: ControlPortReply = await port.ask(READY_PATH, timeout_s=timeout_s)
        except ConnectionError:
            late_s = time.monotonic() - began_s - timeout_s
            return None if late_s > _LATE_SHARE * timeout_s else False
        if reply.status != 200 and reply.document().get("state") in _LEAVING:
            self._fleet.leaves_by_itself(member)
            return None
        return reply.status == 200

    def _judge(self, member: Member, ok: bool) -> None:
        """Count *ok*; the rule's clock runs faster where time is compressed, so that the grace is shorter."""
        health = member.health
        now_s = time.monotonic() * self._compress
        member.health = observe(health, ok, self._settings.health, now_s=now_s)
        if member.health.state == "unhealthy" and health.state != "unhealthy":
            failed = self._settings.health.unhealthy_checks
            self._tell("server-unhealthy", server=member.name, reason=f"{failed} checks in a row failed")
            self._soon()

    # --- readings --------------------------------------------------------------------------------

    async def _read_on(self) -> None:
        try:
            while True:
                now_s = time.monotonic()
                await asyncio.sleep((math.floor(now_s / self._every_s) + 1) * self._every_s - now_s)
                self._take(await self._read())
        finally:
            for port in self._ports.values():
                port.close()

    def _take(self, reading: MonitorSample) -> None:
        self.reading = reading
        if self._on_reading is not None:
            self._on_reading(reading.document())
        self._act(period_over=self._periods.add(reading))
        self._even_out(reading)

    async def _read(self) -> MonitorSample:
        members = list(self._fleet.members.values())
        stats, servers = await asyncio.gather(
            self._load_balancer.stats(), asyncio.gather(*(self._read_one(member) for member in members))
        )
        there = set(self._fleet.members)
        for gone in set(self._ports) - there:
            self._ports.pop(gone).close()
            self._before.pop(gone, None)
        in_balancer = frozenset(name for name, target in stats.items() if target.healthy)
        return reading_of(time.monotonic(), [each for each in servers if each.name in there], in_balancer)

    async def _read_one(self, member: Member) -> ServerReading:
        server = member.server
        observed = None
        if server is not None:
            if member.name not in self._ports:
                self._ports[member.name] = self._fleet.control(server)
            port = self._ports[member.name]
            try:
                reply = await port.ask("/status", timeout_s=_STATUS_SHARE * self._every_s)
                told = reply.document()
                if reply.status == 200 and "cpu_s" in told:
                    observed = Observed(at_s=time.monotonic(), status=told)
            except ConnectionError:
                pass  # a server that does not answer has no numbers; its health is judged elsewhere
        workers = 1 if server is None else len(server.workers)
        reading = server_reading(
            self._before.get(member.name),
            observed,
            name=member.name,
            pid=0 if server is None else server.pid,
            state=member.phase,
            warming=self._fleet.is_warming(member, time.monotonic()),
            capacity=capacity_cores(self._settings.serving, workers, self._cores),
        )
        if observed is not None:
            self._before[member.name] = observed
            member.robots = reading.robots
        return reading

    # --- actions ---------------------------------------------------------------------------------

    def _soon(self) -> None:
        if self._elastic:
            asyncio.get_running_loop().call_soon(self._act)

    def _act(self, period_over: bool = False) -> None:
        if self._elastic:
            now_s = time.monotonic()
            samples = self._periods.samples(now_s)
            self.modifier.act(samples, now_s=now_s, period_over=period_over, hold=self.hold)

    def _even_out(self, reading: MonitorSample) -> None:
        if self._rebalancer is None or self.hold:
            return
        robots = {each.name: each.robots for each in reading.servers if each.state == "healthy"}
        for order in self._rebalancer.orders(robots, reading.time):
            self._fleet.keep(self._move(order))

    async def _move(self, order: Order) -> None:
        member = self._fleet.members.get(order.server)
        if member is None or member.server is None:
            return
        port = self._fleet.control(member.server)
        try:
            target = f"/move?robots={order.robots}&spread_s={order.spread_s:g}"
            reply = await port.ask(target, timeout_s=_ASK_S, method="POST")
        except ConnectionError:
            return  # the next reading asks again
        finally:
            port.close()
        told = reply.document()
        if reply.status < 300 and told.get("robots"):
            self._tell("rebalance", server=order.server, robots=told["robots"], spread_s=told["spread_s"])

    # --- the balancer ----------------------------------------------------------------------------

    async def _keep_balancer(self) -> None:
        """Bring the balancer back on its port whenever it is gone."""
        while True:
            why = await self._load_balancer.wait_over()
            began_s = time.monotonic()
            mark = self._load_balancer.mark
            self._tell("balancer-gone", pid=None if mark is None else mark.pid, reason=why)
            await self._bring_balancer_back()
            seconds = round(time.monotonic() - began_s, 3)
            self._changed()
            mark = self._load_balancer.mark
            self._tell("balancer-back", seconds=seconds, pid=None if mark is None else mark.pid)
            self.watch_spread()

    async def _bring_balancer_back(self) -> None:
        pause_s = LOCAL_INTERVAL_S
        while True:
            self._load_balancer.launch()
            try:
                await self._load_balancer.wait_live(self._settings.local.start_timeout_s)
                return
            except ConfigurationError as error:
                self._tell("balancer-failed", reason=str(error), wait_s=pause_s)
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, _MAX_PAUSE_S)
