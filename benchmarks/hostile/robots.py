"""Round trips of robots that send real PnP problems through the load balancer while it is attacked.

    python -m benchmarks hostile.robots [--robots 20] [--seconds 8] [--only NAME]

For each attack of benchmarks/hostile/attacks.py: a quiet window, the attack (at least as long), a pause.
"Others" send 5 commands per second each, kept; latency counts from the planned time; goodput is the share
of commands planned in the window that returned a pose.  Each attack is compared with the quiet window
before it, so that a slower machine slows both.  The attacker starts and prepares its messages before the
quiet window, because real attackers have machines of their own.

Defends (issue 7): memory of the servers < +64 MiB, every attacker refused or cut off, others' p99 < 2x
of quiet (1.5x beside one robot at 100 times its rate, goodput >= 99 %), 0 robots dropped.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import time
from asyncio.subprocess import Process
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark, command_of
from benchmarks.frame.statistics import percentile
from benchmarks.hostile import attacks
from benchmarks.hostile.attacks import ATTACKS
from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.load.swarm import Swarm
from rse_pf.experiments.results.records import CommandRecord
from rse_pf.local.control.platform import LocalPlatform

REST_S = 3.0
TOKENS = 100
GOODPUT_BAR, P99_BAR, P99_BAR_OF_RATE, MEMORY_BAR_MIB = 0.99, 2.0, 1.5, 64.0
GRACE_S = 6.0


def resident_mib(pids: Sequence[int]) -> float:
    """Return the memory of servers and their workers, MiB."""
    total, family = 0, list(pids)
    for pid in family:
        try:
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            total += int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except OSError:
            continue
        family += [int(child) for child in children]
    return total * os.sysconf("SC_PAGE_SIZE") / 2**20


async def attacker(name: str, cloud: LocalPlatform) -> Process:
    """Start the process of one attack and wait until it is ready: it would have a machine of its own."""
    tokens = json.dumps([cloud.issue_token(f"hostile-{n}") for n in range(TOKENS)]).encode()
    process = await asyncio.create_subprocess_exec(
        *command_of(attacks.run_attack, name, cloud.url),
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(tokens + b"\n")
    await process.stdout.readline()
    return process


async def attack(process: Process, cloud: LocalPlatform) -> tuple[dict[str, Any], float]:
    """Let one attack go; return its outcome and by how many MiB the servers grew."""
    servers = [mark.pid for mark in cloud.backend_servers.marks.values()]
    before = most = resident_mib(servers)
    talking = asyncio.create_task(process.communicate(b"go\n"))
    while not talking.done():
        await asyncio.wait({talking}, timeout=0.1)
        most = max(most, resident_mib(servers))
    outcome, _ = talking.result()
    return json.loads(outcome or b'{"ends": {"attacker failed": 1}}'), most - before


def summarise_window(commands: Sequence[CommandRecord], begin: float, end: float) -> dict[str, Any]:
    """Return what the others saw of commands planned within a window."""
    planned = [command for command in commands if begin <= command.planned < end]
    trips = [command.round_trip_ms for command in planned if command.round_trip_ms is not None]
    codes: dict[str, int] = {}
    for planned_command in planned:
        codes[planned_command.code or "lost"] = codes.get(planned_command.code or "lost", 0) + 1
    return {
        "n": len(planned),
        "goodput": len(trips) / max(1, len(planned)),
        "p50_ms": percentile(trips, 50),
        "p99_ms": percentile(trips, 99),
        "codes": codes,
    }


def is_refused(row: dict[str, Any]) -> bool:
    """Return whether the attacker was refused or cut off, as its kind of attack must be."""
    refused, tried = row["outcome"].get("refused", 0), row["outcome"].get("tried", 1)
    if row["attack"] in ("empty-fragments", "ping-flood"):
        return refused > 0
    return row["attack"] == "rate-flood" or refused >= tried


async def run(names: Sequence[str], robots: int, seconds: float, folder: Path) -> list[dict[str, Any]]:
    """Attack one platform in every named way, one after the other."""
    settings = PlatformSettings()
    rows: list[dict[str, Any]] = []
    dropped: list[float] = []
    origin = time.monotonic()

    def heard(event: Any) -> None:
        if event["event"] == "link-lost":
            dropped.append(event["time"])

    def now() -> float:
        return time.monotonic() - origin

    async with LocalPlatform(settings, state=folder / "platform", port=0, name="hostile") as cloud:
        options = LoadScenario(robots=robots, fps=5.0, seed=7)
        async with Swarm(
            options, url=cloud.url, token_of=cloud.issue_token, session=settings.session, on_event=heard,
            origin=origin,
        ) as swarm:  # fmt: skip
            await swarm.start()
            await swarm.wait_joined(60.0)
            for name in names:
                ready = await attacker(name, cloud)
                await asyncio.sleep(REST_S)
                quiet = now()
                await asyncio.sleep(seconds)
                began = now()
                outcome, grown = await attack(ready, cloud)
                await asyncio.sleep(max(0.0, began + seconds - now()))
                row = {"attack": name, "outcome": outcome, "grown_mib": grown}
                rows.append({**row, "quiet_s": quiet, "began_s": began, "ended_s": now()})
            result = await swarm.finish(GRACE_S)
    for row in rows:
        row["quiet"] = summarise_window(result.commands, row["quiet_s"], row["began_s"])
        row["others"] = summarise_window(result.commands, row["began_s"], row["ended_s"])
        row["dropped"] = sum(row["began_s"] <= at < row["ended_s"] for at in dropped)
        row["twice"] = result.duplicates
    return rows


@benchmark(
    *(
        Bar(
            f"{name}.p99_ratio",
            at_most=P99_BAR_OF_RATE if name == "rate-flood" else P99_BAR,
            unit="times quiet",
        )
        for name in ATTACKS
    ),
    Bar("*.others.goodput", at_least=GOODPUT_BAR),
    Bar("*.dropped", equals=0),
    Bar("*.grown_mib", at_most=MEMORY_BAR_MIB, unit="MiB"),
    Bar("*.is_refused", equals=True),
)
def run_benchmark(
    *, robots: int = 20, seconds: float = 8.0, only: Annotated[tuple[str, ...], "attacks", ATTACKS] = ()
) -> dict[str, Any]:
    """Attack in every way."""
    with tempfile.TemporaryDirectory() as folder:
        rows = asyncio.run(run(list(only or ATTACKS), robots, seconds, Path(folder)))
    for row in rows:
        row |= {
            "p99_ratio": row["others"]["p99_ms"] / row["quiet"]["p99_ms"], "is_refused": is_refused(row)
        }  # fmt: skip
    return {row["attack"]: row for row in rows}
