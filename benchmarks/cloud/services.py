"""New versions of a service while robots call it: how late are they, and is a command lost?

    python -m benchmarks cloud.services [--robots 20] [--rate 5] [--versions 3] [--seconds 10]

Two local servers with the agent's task of AWS each, on one bucket (a folder).  Robots call a stateful Python
service and the built-in echo in turn; every ``--seconds`` a version is published and both agents look at
once, so that the agents' period (15 s) is not part of the numbers.

Defends: no command is lost or out of order while versions change, and echo does not wait for the change.
"""

from __future__ import annotations

import asyncio
import json
import random
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import client_sdk
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.task import AgentConfig, AgentContext
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.state import control_token_file
from rse_pf.object_store import DirectoryStore
from rse_pf.services.custom.installed import install
from rse_pf.services.custom.published_folder import PublishedFolder
from rse_pf.services.custom.publishing import LIST_NAME, archive_name, publish

__all__ = []

_SOURCE = """
from __future__ import annotations
import msgspec

class Request(msgspec.Struct):
    pass

class Reply(msgspec.Struct):
    version: int
    count: int

class Service:
    def __init__(self):
        self.count = 0

    def snapshot(self):
        return str(self.count).encode()

    def restore(self, data):
        self.count = int(data)

    def serve(self, request: Request) -> Reply:
        self.count += 1
        return Reply(version=VERSION, count=self.count)
"""
_AT_ALL_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    robots: int = 20
    rate: Annotated[float, "commands of a robot each second"] = 5.0
    versions: int = 3
    seconds: Annotated[float, "between two versions"] = 10.0


@dataclass
class Heard:
    """What the robots got: times in ms of (service, whether a version was changing), and what went wrong."""

    times_ms: dict[tuple[str, bool], list[float]] = field(default_factory=dict)
    versions: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    disordered: int = 0
    is_changing: bool = False

    def note(self, service: str, ms: float) -> None:
        self.times_ms.setdefault((service, self.is_changing), []).append(ms)


@benchmark(
    Bar("lost", equals=0),
    Bar("out_of_order", equals=0),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Publish versions while robots call."""
    with tempfile.TemporaryDirectory(prefix="rse-pf-services-") as folder:
        return asyncio.run(_run(args, Path(folder)))


async def _run(args: Options, folder: Path) -> dict[str, Any]:
    bucket = DirectoryStore(folder / "artifacts")
    (folder / "artifacts").mkdir()
    (folder / "var").mkdir()
    published = PublishedFolder(folder / "var" / "services")
    _publish(folder, bucket, 1)
    published.install(bucket.get(LIST_NAME), lambda entry: bucket.get(archive_name(entry.archive)))
    settings = PlatformSettings.from_dict(
        {
            "services": {"folder": str(published.link), "follow": True, "accept_weak_isolation": True},
            "local": {"start_timeout_s": 60.0, "warm_standby": False},
        }
    )
    heard = Heard()
    took: list[float] = []
    async with LocalPlatform(settings, state=folder / "platform", servers=2, port=0) as platform:
        agents = [_agent(folder, bucket, server.control_port) for server in platform.servers]
        over = asyncio.Event()
        robots = [
            asyncio.ensure_future(_drive(platform, f"robot-{number}", args.rate, heard, over))
            for number in range(args.robots)
        ]
        for version in range(2, args.versions + 2):
            await asyncio.sleep(args.seconds)
            heard.is_changing, began_s = True, time.monotonic()
            await asyncio.to_thread(_publish, folder, bucket, version)
            for agent in agents:
                await asyncio.to_thread(agent.attempt, "services")
            while min(heard.versions.values(), default=0) < version:
                if time.monotonic() - began_s > _AT_ALL_S:
                    raise SystemExit(f"version {version} did not reach every robot in {_AT_ALL_S:g} s")
                await asyncio.sleep(0.01)  # polls, with a deadline
            took.append(round(time.monotonic() - began_s, 3))
            heard.is_changing = False
        over.set()
        await asyncio.gather(*robots)
    return {
        "robots": args.robots, "rate_per_s": args.rate, "versions": args.versions,
        "publish_to_every_robot_s": took, "lost": heard.lost, "out_of_order": heard.disordered,
        "ms": {
            f"{service}{', while a version changes' if changing else ''}": spread(times)
            for (service, changing), times in sorted(heard.times_ms.items())
        },
    }  # fmt: skip


async def _drive(platform: LocalPlatform, name: str, rate: float, heard: Heard, over: asyncio.Event) -> None:
    token, chance = platform.issue_token(name), random.Random(name)
    async with client_sdk.connect(platform.url, token=token, random=chance) as robot:
        await asyncio.sleep(chance.random() / rate)
        number = 0
        while not over.is_set():
            number += 1
            service = "counter" if number % 2 else "echo"
            began_s = time.monotonic()
            try:
                reply = (await robot.call(service, {}, deadline_s=10.0)).reply
            except RsePfError:
                heard.lost += 1
                continue
            heard.note(service, (time.monotonic() - began_s) * 1e3)
            if service == "counter":
                heard.disordered += reply["count"] != heard.counts.get(name, 0) + 1
                heard.disordered += reply["version"] < heard.versions.get(name, 0)
                heard.counts[name], heard.versions[name] = reply["count"], reply["version"]
            await asyncio.sleep(max(0.0, 1.0 / rate - (time.monotonic() - began_s)))


def _publish(folder: Path, bucket: DirectoryStore, version: int) -> None:
    source = folder / f"version-{version}" / "counter"
    source.mkdir(parents=True)
    manifest = {
        "name": "counter", "language": "python", "entry": "service.py", "kind": "per_robot_state",
    }  # fmt: skip
    (source / "service.json").write_text(json.dumps(manifest))
    (source / "service.py").write_text(f"{_SOURCE}\nVERSION = {version}\n")
    root = folder / f"root-{version}"
    publish(install(source, root), root, bucket, now_s=time.time())


def _agent(folder: Path, bucket: DirectoryStore, port: int) -> Agent:
    context = AgentContext(
        machine=Instance(port, control_token_file(folder / "platform")), clients={"autoscaling": None},
        artifacts=bucket, settings=PlatformSettings(), log=lambda event, **fields: None,
        config=AgentConfig(
            group="g", hook="h", launch_hook="l", keys_name="keys.json",
            keys_file=folder / "var" / "keys.json",
        ),
    )  # fmt: skip
    return Agent(context)
