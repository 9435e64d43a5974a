"""A robot with two regions: two local platforms behind links of 30 and 130 ms there and back.

    python -m benchmarks cloud.regions [--hold 60] [--flapping 300] [--runs 3]

Each platform is a ``rse-pf local`` with one server, behind a relay in this process that delays each way.  A
robot asks echo ten times a second, open loop, while

1. it connects (``--runs`` times): which region, and how long until the first answer;
2. the near platform dies by SIGKILL (``--runs`` times, restarted each time): the longest time without an
   answer, and whether the robot comes back;
3. the near link falls silent: the same, with sockets that stay open;
4. the near link gets slow (400 ms there and back): when the robot changes, and the gap of the change;
5. the near link alternates between slow and fast for ``--flapping`` seconds, in periods shorter than the hold
   time: how often the robot changes.

Relays, robot and platforms share the cores.  ``--hold`` is session.region_hold_s; smaller values only make
the run shorter.

Defends: the nearer region within 2 s of connect; a change within 5 s; 0 commands lost; no flapping.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import client_sdk
from benchmarks.cloud.delaying_proxy import DelayingProxy
from benchmarks.cloud.local_platform import LocalPlatform
from benchmarks.frame.registry import Bar, benchmark
from rse_pf.config import SessionSettings
from rse_pf.errors import RsePfError

__all__ = ["Asker", "measure"]

NEAR_S, FAR_S, SLOW_S = 0.015, 0.065, 0.2
ASK_EVERY_S = 0.1
DEADLINE_S = 8.0
WAIT_S = 900.0
BEFORE_S, AFTER_S = 2.0, 3.0
"""Quiet times before a fault and after a change, so that gaps are seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    hold: float = 60.0
    flapping: float = 300.0
    runs: int = 3


class Asker:
    """Asks at fixed times, whether earlier questions were answered or not."""

    def __init__(self, robot: client_sdk.Robot) -> None:
        self.robot = robot
        self.sent = 0
        self.lost: Counter[str] = Counter()
        self.answers: list[float] = []
        self._asked: set[asyncio.Task[None]] = set()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Asker:
        """Begin."""
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Ask no more, and wait for the last answers."""
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(*self._asked)

    def longest_gap_s(self, since: float) -> float:
        """Return the longest time between two answers, from *since* on."""
        times = [since, *(at for at in self.answers if at >= since)]
        return max((later - before for before, later in pairwise(times)), default=0.0)

    async def _run(self) -> None:
        due = time.monotonic()
        while True:
            task = asyncio.create_task(self._ask(self.sent))
            self._asked.add(task)
            task.add_done_callback(self._asked.discard)
            self.sent += 1
            due += ASK_EVERY_S
            await asyncio.sleep(max(0.0, due - time.monotonic()))

    async def _ask(self, number: int) -> None:
        try:
            answer = await self.robot.call("echo", {"value": number}, deadline_s=DEADLINE_S)
            if answer.reply != {"value": number}:
                self.lost["wrong"] += 1
            self.answers.append(time.monotonic())
        except RsePfError as error:
            self.lost[error.code] += 1


class Site:
    """Both platforms, which accept the same tokens, and the links to them; use it with ``async with``."""

    def __init__(self, folder: Path, hold_s: float) -> None:
        self.settings = SessionSettings(region_hold_s=hold_s)
        seed = os.urandom(32)
        self.near, self.far = (LocalPlatform(n, folder, servers=1, seed=seed) for n in ("near", "far"))
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Site:
        """Start both platforms and their links."""
        for local in (self.near, self.far):
            await asyncio.to_thread(local.__enter__)
            self._stack.callback(local.__exit__, None, None, None)
        self.near_link = await self._stack.enter_async_context(DelayingProxy(self.near.port, NEAR_S))
        self.far_link = await self._stack.enter_async_context(DelayingProxy(self.far.port, FAR_S))
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop everything."""
        await self._stack.aclose()

    def robot(self) -> client_sdk.Robot:
        """Return a robot that knows both regions, the far one first."""
        urls = [self.far_link.url, self.near_link.url]
        return client_sdk.connect(urls, token=self.near.token("robot-1"), settings=self.settings)

    async def in_region(self, robot: client_sdk.Robot, link: DelayingProxy) -> float | None:
        """Return after how many seconds *robot* uses the region behind *link*, None if it does not."""
        began = time.monotonic()
        while time.monotonic() - began < WAIT_S:
            if robot.stats.region == link.url:
                return round(time.monotonic() - began, 3)
            await asyncio.sleep(0.005)  # polls, with a deadline
        return None

    async def restart_near(self) -> None:
        """Start the near platform again, at another port of its own."""
        await asyncio.to_thread(self.near.__enter__)
        self.near_link.target = self.near.port


async def connects(site: Site) -> dict[str, Any]:
    """Connect, ask once, and return where and when that was answered."""
    began = time.monotonic()
    async with site.robot() as robot:
        await robot.call("echo", {})
        answered_s = time.monotonic() - began
        return {"near": robot.stats.region == site.near_link.url, "answered_s": round(answered_s, 3)}


async def loses_near(site: Site, how: str) -> dict[str, Any]:
    """Take the near region away and give it back; return what the robot noticed of it."""
    async with site.robot() as robot, Asker(robot) as asker:
        await asyncio.sleep(BEFORE_S)
        began = time.monotonic()
        if how == "dies":
            await asyncio.to_thread(site.near.kill)
        else:
            site.near_link.is_stalled = True
        changed_s = await site.in_region(robot, site.far_link)
        await asyncio.sleep(AFTER_S)
        gap_s = asker.longest_gap_s(began)
        if how == "dies":
            await site.restart_near()
        else:
            # What was dropped cannot arrive later: these connections are broken.
            await site.near_link.die()
            site.near_link.is_stalled = False
            await site.near_link.listen()
        back_s = await site.in_region(robot, site.near_link)
    return _summarise(
        asker, {"changed_after_s": changed_s, "longest_gap_s": round(gap_s, 3), "back_s": back_s}
    )


async def gets_slow(site: Site) -> dict[str, Any]:
    """Make the near link slow for good, and fast again after the change."""
    async with site.robot() as robot, Asker(robot) as asker:
        await asyncio.sleep(BEFORE_S)
        began, site.near_link.delay_s = time.monotonic(), SLOW_S
        changed_s = await site.in_region(robot, site.far_link)
        await asyncio.sleep(AFTER_S)
        gap_s = asker.longest_gap_s(began)
        site.near_link.delay_s = NEAR_S
        back_s = await site.in_region(robot, site.near_link)
    return _summarise(
        asker, {"changed_after_s": changed_s, "longest_gap_s": round(gap_s, 3), "back_s": back_s}
    )


async def flaps(site: Site, seconds: float) -> dict[str, Any]:
    """Make the near link slow and fast in turn, for less than the hold time each."""
    period_s = 0.5 * site.settings.region_hold_s
    async with site.robot() as robot, Asker(robot) as asker:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            for delay_s in (SLOW_S, NEAR_S):
                site.near_link.delay_s = delay_s
                await asyncio.sleep(period_s)
        changes = robot.stats.region_changes
    return _summarise(asker, {"seconds": seconds, "changes": changes})


def _summarise(asker: Asker, figures: dict[str, Any]) -> dict[str, Any]:
    stats = asker.robot.stats
    return {
        **figures,
        "sent": asker.sent,
        "answered": len(asker.answers),
        "lost": dict(asker.lost),
        "twice": stats.duplicates,
        "resent": stats.resent,
    }


async def measure(args: Options, folder: Path) -> dict[str, Any]:
    """Run all parts and return what was found."""
    figures: dict[str, Any] = {"hold_s": args.hold}
    async with Site(folder, args.hold) as site:
        figures["connects"] = [await connects(site) for _ in range(args.runs)]
        figures["dies"] = [await loses_near(site, "dies") for _ in range(args.runs)]
        figures["falls silent"] = [await loses_near(site, "falls silent")]
        figures["gets slow"] = [await gets_slow(site)]
        figures["flaps"] = [await flaps(site, args.flapping)]
    return figures


@benchmark(
    Bar("connects.*.near", equals=True),
    Bar("connects.*.answered_s", at_most=2.0, unit="s"),
    *(
        Bar(f"{part}.*.longest_gap_s", at_most=5.0, unit="s")
        for part in ("dies", "falls silent", "gets slow")
    ),
    Bar("unanswered", equals=0),
    Bar("twice", equals=0),
    Bar("flaps.*.changes", equals=0),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Run all parts."""
    with tempfile.TemporaryDirectory(prefix="regions-") as folder:
        figures = asyncio.run(measure(args, Path(folder)))
    rows = [row for part in ("dies", "falls silent", "gets slow", "flaps") for row in figures[part]]
    unanswered = sum(row["sent"] - row["answered"] for row in rows)
    return {**figures, "unanswered": unanswered, "twice": sum(row["twice"] for row in rows)}
