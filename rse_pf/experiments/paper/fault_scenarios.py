"""The faults, each as a short story played on a stage while robots ask on.

A scenario makes its fault, logs it with the pid or name of what was hit, and waits until its consequences are
over or its patience is.  Promises to judge nothing: that is `rse_pf.experiments.paper.robustness_report`.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.experiments.paper.harness import Harness, watch

__all__ = ["SCENARIOS", "Scenario"]

_PATIENCE_S = 30.0
_AFTER_S = 6.0
_RANDOM_EVERY_S = 3.0
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One fault: what it needs, and how it is played.

    ``play(stage, seconds, seed)`` gets the length that its fault lasts and the seed of its choices; None
    means that the platform itself is a child process, see `rse_pf.experiments.paper.control_plane_fault`.
    """

    play: Callable[[Harness, float, int], Awaitable[None]] | None = None
    seconds: float = 0.0
    servers: int = 2
    needs_link: bool = False
    slow: bool = False


async def _kill(stage: Harness, seconds: float, seed: int) -> None:
    began = stage.now()
    stage.kill(_AFTER_S)
    await _replaced(stage, began)
    await watch(stage, _AFTER_S)


async def _stop(stage: Harness, seconds: float, seed: int) -> None:
    victim, began = stage.busiest(), stage.now()
    stage.tell("fault", fault="SIGSTOP", server=victim.name, pid=victim.pid, watch_s=10.0)
    stage.cloud.pause(victim.name)
    await _replaced(stage, began)
    await watch(stage, _AFTER_S)


async def _balancer(stage: Harness, seconds: float, seed: int) -> None:
    began = stage.now()
    mark = stage.cloud.load_balancer.mark
    stage.tell("fault", fault="kill -9 of the balancer", pid=None if mark is None else mark.pid, watch_s=8.0)
    stage.cloud.kill_balancer()
    await stage.until(lambda: bool(stage.happened("balancer-back", began)), _PATIENCE_S)
    await watch(stage, _AFTER_S)


async def _scale_in(stage: Harness, seconds: float, seed: int) -> None:
    victim = stage.busiest()
    stage.tell("fault", fault="scale-in", server=victim.name, pid=victim.pid, watch_s=10.0)
    await stage.cloud.drain(victim.name, reason="experiment: scale-in under load")
    await watch(stage, _AFTER_S)


async def _roll(stage: Harness, seconds: float, seed: int) -> None:
    began = stage.now()
    stage.tell("fault", fault="rolling replacement", watch_s=60.0)
    await stage.cloud.roll()
    stage.tell("rolled", seconds=round(stage.now() - began, 3))
    await watch(stage, _AFTER_S)


async def _scale_out(stage: Harness, seconds: float, seed: int) -> None:
    began = stage.now()
    stage.tell("fault", fault="scale-out with everybody connected", watch_s=20.0)
    await stage.cloud.grow(1, "experiment: scale-out with everybody connected")
    await stage.until(lambda: bool(stage.happened("server-healthy", began)), _PATIENCE_S)
    await watch(stage, 17.0)


async def _wifi(stage: Harness, seconds: float, seed: int) -> None:
    link: Any = stage.link
    stage.tell("fault", fault="link cut", seconds=seconds, watch_s=seconds + 10.0)
    await link.cut()
    looking = asyncio.ensure_future(_tell_when_empty(stage))
    try:
        await watch(stage, seconds)
    finally:
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
    await link.heal()
    stage.tell("healed")
    await watch(stage, _AFTER_S)


async def _tell_when_empty(stage: Harness) -> None:
    """Log when no server has a robot any more; a reading a second would be too coarse for that."""
    while True:
        told = await stage.cloud.status()
        if len(told) == len(stage.cloud.servers) and not any(status["robots"] for status in told):
            stage.tell("servers-empty")
            return
        await asyncio.sleep(_LOOK_S)


async def _random(stage: Harness, seconds: float, seed: int) -> None:
    """Fault after fault, drawn from *seed*; the next waits until two healthy servers are left to be hit."""
    choice, end = random.Random(seed), stage.now() + seconds
    _resources(stage, "before")
    while stage.now() < end:
        await stage.until(lambda: stage.readings[-1].healthy_servers >= 2, _PATIENCE_S)
        await _one_of_many(stage, choice.choice(("kill", "stop", "balancer", "scale-in")))
        await watch(stage, _RANDOM_EVERY_S)
    await stage.settled(5.0, _PATIENCE_S)
    await watch(stage, 5.0)
    _resources(stage, "after")


async def _one_of_many(stage: Harness, kind: str) -> None:
    if kind == "kill":
        stage.kill(_AFTER_S)
    elif kind == "stop":
        victim = stage.busiest()
        stage.tell("fault", fault="SIGSTOP", server=victim.name, pid=victim.pid, watch_s=_AFTER_S)
        stage.cloud.pause(victim.name)
    elif kind == "balancer":
        began = stage.now()
        stage.tell("fault", fault="kill -9 of the balancer", watch_s=_AFTER_S)
        stage.cloud.kill_balancer()
        await stage.until(lambda: bool(stage.happened("balancer-back", began)), _PATIENCE_S)
    else:
        began, victim = stage.now(), stage.busiest()
        stage.tell("fault", fault="scale-in", server=victim.name, pid=victim.pid, watch_s=_AFTER_S)
        await stage.cloud.grow(1, "experiment: before a scale-in")
        if await stage.until(lambda: bool(stage.happened("server-healthy", began)), _PATIENCE_S):
            await stage.cloud.drain(victim.name, reason="experiment: scale-in under load")


async def _replaced(stage: Harness, began: float) -> None:
    """Wait until a server that was launched after *began* is healthy."""

    def replaced() -> bool:
        new = {each["server"] for each in stage.happened("server-launched", began)}
        return any(each["server"] in new for each in stage.happened("server-healthy", began))

    await stage.until(replaced, _PATIENCE_S)


def _resources(stage: Harness, when: str) -> None:
    """Log resident memory and open descriptors of the servers' supervisors, which is where leaks gather."""
    pids = [server.pid for server in stage.cloud.servers]
    pids += [worker for server in stage.cloud.servers for worker in server.workers]
    page = os.sysconf("SC_PAGE_SIZE")
    memory, descriptors, processes = 0, 0, 0
    for pid in pids:
        try:
            resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * page
            opened = len(os.listdir(f"/proc/{pid}/fd"))
        except OSError:  # it left while we looked
            continue
        memory, descriptors, processes = memory + resident, descriptors + opened, processes + 1
    stage.tell(
        "resources", when=when, memory_bytes=memory, descriptors=descriptors, processes=max(processes, 1)
    )


SCENARIOS: dict[str, Scenario] = {
    "kill": Scenario(play=_kill),
    "stop": Scenario(play=_stop),
    "balancer": Scenario(play=_balancer),
    "control-plane": Scenario(seconds=30.0),
    "wifi": Scenario(play=_wifi, seconds=30.0, needs_link=True),
    "scale-in": Scenario(play=_scale_in, servers=3),
    "roll": Scenario(play=_roll),
    "scale-out": Scenario(play=_scale_out),
    "random": Scenario(play=_random, seconds=600.0, servers=3, slow=True),
}
"""Every fault by its name on the command line; the control plane's is played by a file of its own."""
