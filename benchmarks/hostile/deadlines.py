"""Measure what a robot with impossible deadlines, and a tenant that wants every sandbox, take from others.

    python -m benchmarks hostile.deadlines [--seconds 120] [--only own shared sandboxes]

A service of 0.3 s is asked by six robots of three tenants, once a second each.  Beside them, after a quiet
window of a quarter of the time, a robot of a fourth tenant asks with deadlines of 60 ms as fast as it can:
in the row ``own`` with another payload each time, in the row ``shared`` with the payload that all others use.
In the row ``sandboxes``, 64 robots of one tenant ask without a pause for the 16 sandboxes of a server before
the others come.  Latency counts from the planned time.

Defends (issue 14): others' answers 100 %, nothing is poison for them; 64 sandboxes wanted by one tenant are a
typed failure for that tenant alone.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from benchmarks.hostile.sandboxes import Row, Server, serving
from rse_pf.errors import RsePfError
from rse_pf.services.custom.installed import install

SLOW = """
import time
import msgspec

class Request(msgspec.Struct):
    number: int = 0

class Reply(msgspec.Struct):
    number: int

def serve(request: Request) -> Reply:
    time.sleep(0.3)  # the service is slow and idle meanwhile, so that only its time is measured
    return Reply(number=request.number)
"""
SERVICE, COMMON_PAYLOAD = "slow", {"number": 7}
ROWS = ("own", "shared", "sandboxes")
OTHERS = [(f"tenant-{i}", f"robot-{j}") for i in range(3) for j in range(2)]
HOSTILE_DEADLINE_S, DEADLINE_S, PERIOD_S = 0.06, 5.0, 1.0
PLACES, WANTED = 16, 64
_BUSY_PAUSE_S = 0.2


@dataclass
class Seen:
    """What robots saw: seconds from the planned time of each command, and how it ended."""

    times_s: list[float] = field(default_factory=list)
    codes: Counter[str] = field(default_factory=Counter)

    def row(self, prefix: str) -> Row:
        """Return the numbers; the times are those of answers only."""
        n = sum(self.codes.values())
        return {
            f"{prefix}_n": n, f"{prefix}_answered_percent": 100 * self.codes["ok"] / max(1, n),
            f"{prefix}_codes": dict(self.codes),
            f"{prefix}_ms": spread(1e3 * time_s for time_s in self.times_s),
        }  # fmt: skip


async def ask(robot: Any, payload: Row, deadline_s: float, planned: float, seen: Seen) -> str:
    """Call the service once; return "ok" or the error code."""
    try:
        await robot.call(SERVICE, payload, deadline_s=deadline_s, keep=True)
    except RsePfError as error:
        seen.codes[error.code] += 1
        return error.code
    seen.times_s.append(time.perf_counter() - planned)
    seen.codes["ok"] += 1
    return "ok"


async def other(
    server: Server, index: int, quiet: Seen, hostile: Seen, attack_s: float, end_s: float
) -> None:
    """Ask once a second, before and during the attack."""
    tenant, name = OTHERS[index]
    async with server.robot(name, tenant) as robot:
        planned = time.perf_counter() + PERIOD_S * index / len(OTHERS)
        while planned < end_s:
            await asyncio.sleep(max(0.0, planned - time.perf_counter()))
            await ask(robot, COMMON_PAYLOAD, DEADLINE_S, planned, quiet if planned < attack_s else hostile)
            planned += PERIOD_S


async def deadlines(folder: Path, seconds: float, *, row: str, payload_of: Callable[[int], Row]) -> Row:
    """Let one robot overrun its deadlines beside the others."""
    quiet, beside, attacker = Seen(), Seen(), Seen()
    async with serving(folder) as server:
        attack_s = time.perf_counter() + max(10.0, seconds / 4)
        end_s = attack_s + seconds
        others = [
            asyncio.ensure_future(other(server, i, quiet, beside, attack_s, end_s))
            for i in range(len(OTHERS))
        ]
        async with server.robot("robot-0", "hostile") as robot:
            await asyncio.sleep(attack_s - time.perf_counter())  # the others alone, to compare with
            number = 1000
            while time.perf_counter() < end_s:
                number += 1
                payload = payload_of(number)
                code = await ask(robot, payload, HOSTILE_DEADLINE_S, time.perf_counter(), attacker)
                pause_s = 0.0 if code == "expired" else HOSTILE_DEADLINE_S
                await asyncio.sleep(pause_s)  # refused: the pace at which an expired call would have ended
        await asyncio.gather(*others)
        status, blocks = server.control("/status"), server.control("/blocks")["blocks"]
    return {
        "row": row, "seconds": seconds, **quiet.row("quiet"), **beside.row("others"),
        "hostile_codes": dict(attacker.codes), "counts": status["isolation"]["counts"],
        "refused_to_others": [block for block in blocks if block["tenant"] != "hostile"],
        "refused_to_hostile": [block["reason"] for block in blocks if block["tenant"] == "hostile"],
    }  # fmt: skip


async def sandboxes(folder: Path, seconds: float) -> Row:
    """Let one tenant take every sandbox before the others come."""
    hostile, seen, first = Seen(), Seen(), []
    async with serving(folder, max_sandboxes=PLACES) as server:
        end_s = time.perf_counter() + seconds

        async def hog(index: int) -> None:
            async with server.robot(f"robot-{index}", "hostile") as robot:
                while time.perf_counter() < end_s:
                    now = time.perf_counter()
                    if await ask(robot, {"number": index}, DEADLINE_S, now, hostile) != "ok":
                        await asyncio.sleep(_BUSY_PAUSE_S)

        async def guest(index: int) -> None:
            tenant, name = OTHERS[index]
            async with server.robot(name, tenant) as robot:
                began = time.perf_counter()
                while await ask(robot, COMMON_PAYLOAD, DEADLINE_S, began, Seen()) != "ok":
                    await asyncio.sleep(_BUSY_PAUSE_S)
                first.append(time.perf_counter() - began)
                planned = time.perf_counter()
                while planned < end_s:
                    await asyncio.sleep(max(0.0, planned - time.perf_counter()))
                    await ask(robot, COMMON_PAYLOAD, DEADLINE_S, planned, seen)
                    planned += PERIOD_S

        hogs = [asyncio.ensure_future(hog(i)) for i in range(WANTED)]
        await asyncio.sleep(min(3.0, seconds / 4))
        held_by_one_tenant = server.control("/status")["isolation"]["sandboxes"]
        await asyncio.gather(*(guest(i) for i in range(len(OTHERS))), *hogs)
    return {
        "row": f"{WANTED} sandboxes of {PLACES} wanted by one tenant", "seconds": seconds,
        "held_before_others_came": held_by_one_tenant, "others_first_answer_worst_s": round(max(first), 2),
        **seen.row("others"), "hostile_codes": dict(hostile.codes),
    }  # fmt: skip


async def measure(only: list[str], seconds: float) -> list[Row]:
    """Return the rows and print each as soon as it is measured."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="rse-pf-deadlines-") as temporary:
        folder = Path(temporary)
        made = folder / SERVICE
        made.mkdir()
        (made / "service.py").write_text(SLOW)
        manifest = {"name": SERVICE, "language": "python", "entry": "service.py", "kind": "stateless"}
        (made / "service.json").write_text(json.dumps(manifest))
        install(made, folder / "services")
        works: dict[str, Callable[[], Awaitable[Row]]] = {
            "own": lambda: deadlines(
                folder, seconds, row="deadlines of 60 ms", payload_of=lambda n: {"number": n}
            ),
            "shared": lambda: deadlines(
                folder,
                seconds,
                row="the same with a payload that others use",
                payload_of=lambda _: COMMON_PAYLOAD,
            ),
            "sandboxes": lambda: sandboxes(folder, min(seconds, 60.0)),
        }
        for name in only:
            row = await works[name]()
            say(row)
            rows.append(row)
    return rows


@benchmark(
    *(Bar(f"rows.*.{who}_answered_percent", at_least=100.0, unit="%") for who in ("others", "quiet")),
)
def run_benchmark(
    *, only: Annotated[tuple[str, ...], "rows", ROWS] = ROWS, seconds: float = 120.0
) -> dict[str, Any]:
    """Measure the rows."""
    return {"rows": asyncio.run(measure(list(only), seconds))}
