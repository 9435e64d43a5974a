"""Three real servers with the agents of AWS: 60, 60 and 0 robots, on a CloudWatch that shows numbers late.

    python -m benchmarks cloud.rebalancing [--robots 120] [--fps 2] [--profile fast] [--watch-s 60]

Two local servers get all robots; then a third one joins, and the control plane moves nobody.  Each server has
the tasks of its agent (publish, rebalance) with the real control port, fake instance metadata, and one fake
CloudWatch in this process.  The time counts from the moment the third server is healthy.

Defends: within 20 % of even in 60 s, and no command lost.  That nothing moves in the ten minutes after is in
``tests/aws/fleet/test_rebalancing.py``, on fake time; ``--watch-s 600`` shows it here.
"""

from __future__ import annotations

import asyncio
import tempfile
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.cloud.delayed_cloudwatch import DELAY_S, DelayedCloudWatch
from benchmarks.frame.registry import Bar, benchmark
from rse_pf.aws.fleet.agent import Agent, AgentConfig, AgentContext
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.task import AgentState, Phase
from rse_pf.aws.fleet.tasks import rebalancing, server_metrics
from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.load.swarm import Swarm
from rse_pf.experiments.results.summary import summarise
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.state import control_token_file
from rse_pf.object_store import MemoryStore

__all__ = []

WITHIN_S, MARGIN = 60.0, 0.2
_STEP_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    robots: int = 120
    fps: float = 2.0
    profile: Literal["fast", "paper"] = "fast"
    watch_s: Annotated[float, "time after all are even"] = 60.0
    delay_s: Annotated[float, "until CloudWatch shows a number"] = DELAY_S


class LocalInstance(Instance):
    """An instance with a real server and without metadata."""

    def __init__(self, name: str, port: int, token_file: Path) -> None:
        super().__init__(port, token_file)
        self._name = name

    def instance_id(self) -> str:
        """Return the name of the server."""
        return self._name


@benchmark(
    Bar("even_after_s", at_most=WITHIN_S, unit="s"),
    Bar("left_even_s", equals=0.0),
    Bar("lost", equals=0),
    Bar("failed", equals=0),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Run once."""
    return asyncio.run(_measure(args))


async def _measure(args: Options) -> dict[str, Any]:
    settings = PlatformSettings.from_dict(
        {"scaling": {"profile": args.profile}, "serving": {"workers": 1}, "local": {"warm_standby": False}}
    )
    cloudwatch = DelayedCloudWatch(time.monotonic, args.delay_s)
    with tempfile.TemporaryDirectory() as folder:
        state = Path(folder) / "state"
        platform = LocalPlatform(
            settings, state=state, servers=2, port=0,
            control=ControlOptions(elastic=False, rebalance=False, on_sample=lambda sample: None),
        )  # fmt: skip
        async with platform:
            swarm = Swarm(
                LoadScenario(robots=args.robots, fps=args.fps), url=platform.url,
                token_of=platform.issue_token, session=settings.session,
            )  # fmt: skip
            async with swarm:
                await swarm.start()
                await swarm.wait_joined(60.0)
                agents = Agents(settings, cloudwatch, control_token_file(state))
                with agents:
                    agents.follow(platform)
                    await asyncio.sleep(2.0)  # all robots ask before the new server
                    before = await _robots(platform)
                    await platform.grow(1, "a new server")
                    began_s = time.monotonic()
                    agents.follow(platform)
                    course = await _watch(platform, began_s, args)
                answers = await swarm.finish()
    counts = summarise(answers.commands)["commands"]
    return {
        "robots": args.robots, "fps": args.fps, "profile": args.profile, "delay_s": args.delay_s,
        "before": before, **course, "lost": counts["lost"], "failed": counts["failed"],
        "twice": answers.duplicates, "commands": counts["sent"], "moves": answers.moves,
        "orders": agents.orders,
        "cloudwatch_reads": cloudwatch.reads,

    }  # fmt: skip


class Agents:
    """The agents of all servers, in one thread: their calls block."""

    def __init__(self, settings: PlatformSettings, cloudwatch: DelayedCloudWatch, token_file: Path) -> None:
        self.orders: list[dict[str, Any]] = []
        self._settings = settings
        self._cloudwatch = cloudwatch
        self._token_file = token_file
        self._agents: dict[str, Agent] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Agents:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def follow(self, platform: LocalPlatform) -> None:
        """Give each server that has none an agent."""
        for server in platform.servers:
            if server.name not in self._agents:
                context = AgentContext(
                    machine=LocalInstance(server.name, server.control_port, self._token_file),
                    clients={"cloudwatch": self._cloudwatch}, artifacts=MemoryStore(),
                    settings=self._settings, log=self._log, state=AgentState(phase=Phase.SERVING),
                    config=AgentConfig(group="rse-pf", hook="", keys_name="keys", keys_file=Path("none")),
                )  # fmt: skip
                tasks = (server_metrics.task, rebalancing.task)
                self._agents = {**self._agents, server.name: Agent(context, tasks)}

    def _run(self) -> None:
        while not self._over.wait(_STEP_S):
            for agent in list(self._agents.values()):
                agent.step()

    def _log(self, event: str, **fields: Any) -> None:
        self.orders.append({"event": event, **fields})


async def _watch(platform: LocalPlatform, began_s: float, args: Options) -> dict[str, Any]:
    """Return when all servers were even, and for how long they were not any more after that."""
    course, even_after_s, left_even_s = [], None, 0.0
    while True:
        await asyncio.sleep(_STEP_S)
        robots, now_s = await _robots(platform), time.monotonic() - began_s
        course.append([round(now_s, 1), *robots.values()])
        even = sum(robots.values()) / len(robots)
        if all(abs(count - even) <= MARGIN * even for count in robots.values()):
            even_after_s = even_after_s or round(now_s, 1)
        elif even_after_s is not None:
            left_even_s += _STEP_S
        limit_s = 4 * WITHIN_S if even_after_s is None else even_after_s + args.watch_s
        if now_s >= limit_s:
            return {
                "after": dict(robots), "even_after_s": even_after_s, "left_even_s": left_even_s,
                "course": course[:: max(1, len(course) // 20)],
            }  # fmt: skip


async def _robots(platform: LocalPlatform) -> Mapping[str, int]:
    return {str(server["server"]): int(server["robots"]) for server in await platform.status()}
