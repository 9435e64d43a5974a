"""The faults that `rse-pf experiment robustness` injects while robots send commands.

A scenario injects its fault, records an event with the pid or name of the target, and waits until the
platform has recovered or a timeout has passed.  `rse_pf.extensions.experiments.paper.robustness` computes the
figures.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.extensions.experiments.harness import Harness

__all__ = ["SCENARIOS", "Scenario"]

# Longest wait for the recovery of the platform, in seconds.
_TIMEOUT_S = 30.0
# Seconds for which commands are still recorded after a fault and its recovery.
_RECORDED_AFTER_S = 6.0
# Pause between two random faults, in seconds.
_RANDOM_EVERY_S = 3.0
# Time between two requests for the status of the servers during a link cut, in seconds.
_STATUS_POLL_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One fault, with the number of servers that it needs, and whether it needs an emulated network link.

    ``inject(harness, seconds, seed)`` injects the fault; it gets the duration of the fault (``seconds``
    divided by ``--speed``) and the seed of random choices.  None stands for the fault of the control plane,
    whose platform is a child process, see `rse_pf.extensions.experiments.paper.control_plane_fault`.  A
    ``slow`` fault runs only if ``--only`` names it.
    """

    inject: Callable[[Harness, float, int], Awaitable[None]] | None = None
    seconds: float = 0.0
    servers: int = 2
    needs_link: bool = False
    slow: bool = False


async def _kill(harness: Harness, seconds: float, seed: int) -> None:
    began = harness.now()
    harness.kill(_RECORDED_AFTER_S)
    await _wait_replaced(harness, began)
    await harness.run_for(_RECORDED_AFTER_S)


async def _stop(harness: Harness, seconds: float, seed: int) -> None:
    began = harness.now()
    _pause_busiest(harness, 10.0)
    await _wait_replaced(harness, began)
    await harness.run_for(_RECORDED_AFTER_S)


async def _balancer(harness: Harness, seconds: float, seed: int) -> None:
    await _kill_balancer(harness, 8.0)
    await harness.run_for(_RECORDED_AFTER_S)


async def _scale_in(harness: Harness, seconds: float, seed: int) -> None:
    await _drain_busiest(harness, 10.0)
    await harness.run_for(_RECORDED_AFTER_S)


async def _roll(harness: Harness, seconds: float, seed: int) -> None:
    began = harness.now()
    harness.log("fault", fault="rolling replacement", watch_s=60.0)
    await harness.platform.roll()
    harness.log("rolled", seconds=round(harness.now() - began, 3))
    await harness.run_for(_RECORDED_AFTER_S)


async def _scale_out(harness: Harness, seconds: float, seed: int) -> None:
    began = harness.now()
    harness.log("fault", fault="scale-out with all robots connected", watch_s=20.0)
    await harness.platform.grow(1, "experiment: scale-out with all robots connected")
    await harness.wait_for(lambda: bool(harness.events_since("server-healthy", began)), _TIMEOUT_S)
    await harness.run_for(17.0)


async def _wifi(harness: Harness, seconds: float, seed: int) -> None:
    link: Any = harness.link
    harness.log("fault", fault="link cut", seconds=seconds, watch_s=seconds + 10.0)
    await link.cut()
    polling = asyncio.ensure_future(_log_when_empty(harness))
    try:
        await harness.run_for(seconds)
    finally:
        polling.cancel()
        await asyncio.gather(polling, return_exceptions=True)
    await link.heal()
    harness.log("healed")
    await harness.run_for(_RECORDED_AFTER_S)


async def _log_when_empty(harness: Harness) -> None:
    """Record the event ``servers-empty`` once no server has a connected robot; checked every 0.1 s."""
    while True:
        servers = await harness.platform.status()
        if len(servers) == len(harness.platform.servers) and not any(server["robots"] for server in servers):
            harness.log("servers-empty")
            return
        await asyncio.sleep(_STATUS_POLL_S)


async def _random(harness: Harness, seconds: float, seed: int) -> None:
    """Inject faults drawn with *seed* for *seconds*, each once at least two servers are healthy.

    Memory and file descriptors of the servers are recorded before and after.
    """
    choice, end = random.Random(seed), harness.now() + seconds
    _resources(harness, "before")
    while harness.now() < end:
        await harness.wait_for(lambda: harness.samples[-1].healthy_servers >= 2, _TIMEOUT_S)
        await _random_fault(harness, choice.choice(("kill", "stop", "balancer", "scale-in")))
        await harness.run_for(_RANDOM_EVERY_S)
    await harness.wait_quiet(5.0, _TIMEOUT_S)
    await harness.run_for(5.0)
    _resources(harness, "after")


async def _random_fault(harness: Harness, kind: str) -> None:
    if kind == "kill":
        harness.kill(_RECORDED_AFTER_S)
    elif kind == "stop":
        _pause_busiest(harness, _RECORDED_AFTER_S)
    elif kind == "balancer":
        await _kill_balancer(harness, _RECORDED_AFTER_S)
    else:
        await _drain_busiest(harness, _RECORDED_AFTER_S, grow_first=True)


def _pause_busiest(harness: Harness, watch_s: float) -> None:
    victim = harness.busiest()
    harness.log("fault", fault="SIGSTOP", server=victim.name, pid=victim.pid, watch_s=watch_s)
    harness.platform.pause(victim.name)


async def _kill_balancer(harness: Harness, watch_s: float) -> None:
    began, mark = harness.now(), harness.platform.load_balancer.process.mark
    pid = None if mark is None else mark.pid
    harness.log("fault", fault="kill -9 of the balancer", pid=pid, watch_s=watch_s)
    harness.platform.kill_balancer()
    await harness.wait_for(lambda: bool(harness.events_since("balancer-back", began)), _TIMEOUT_S)


async def _drain_busiest(harness: Harness, watch_s: float, *, grow_first: bool = False) -> None:
    began, victim = harness.now(), harness.busiest()
    harness.log("fault", fault="scale-in", server=victim.name, pid=victim.pid, watch_s=watch_s)
    if grow_first:
        await harness.platform.grow(1, "experiment: before a scale-in")
        if not await harness.wait_for(
            lambda: bool(harness.events_since("server-healthy", began)), _TIMEOUT_S
        ):
            return
    await harness.platform.drain(victim.name, reason="experiment: scale-in under load")


async def _wait_replaced(harness: Harness, began: float) -> None:
    """Wait until a server that was launched after *began* is healthy, for at most 30 s."""

    def replaced() -> bool:
        new = {event["server"] for event in harness.events_since("server-launched", began)}
        return any(event["server"] in new for event in harness.events_since("server-healthy", began))

    await harness.wait_for(replaced, _TIMEOUT_S)


def _resources(harness: Harness, when: str) -> None:
    """Record the event ``resources``: resident memory and open file descriptors of all servers' processes."""
    pids = [server.pid for server in harness.platform.servers]
    pids += [worker for server in harness.platform.servers for worker in server.workers]
    page = os.sysconf("SC_PAGE_SIZE")
    memory, descriptors, processes = 0, 0, 0
    for pid in pids:
        try:
            resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * page
            opened = len(os.listdir(f"/proc/{pid}/fd"))
        except OSError:  # the process has exited meanwhile
            continue
        memory, descriptors, processes = memory + resident, descriptors + opened, processes + 1
    harness.log(
        "resources", when=when, memory_bytes=memory, descriptors=descriptors, processes=max(processes, 1)
    )


SCENARIOS: dict[str, Scenario] = {
    "kill": Scenario(inject=_kill),
    "stop": Scenario(inject=_stop),
    "balancer": Scenario(inject=_balancer),
    "control-plane": Scenario(seconds=30.0),
    "wifi": Scenario(inject=_wifi, seconds=30.0, needs_link=True),
    "scale-in": Scenario(inject=_scale_in, servers=3),
    "roll": Scenario(inject=_roll),
    "scale-out": Scenario(inject=_scale_out),
    "random": Scenario(inject=_random, seconds=600.0, servers=3, slow=True),
}
"""Every fault of the robustness experiment by its name in ``--only``."""
