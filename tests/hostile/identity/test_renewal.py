"""The SDK shows a fresh token in time: a session passes the end of its first token without a gap."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

import pytest

from client_sdk import Robot, connect
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

FIRST_LIFE_S, NEXT_LIFE_S = 3.0, 60.0
AFTER_S = 0.5
DEADLINE_S = 60.0
MAX_GAP_S = 1.0
"""Between two answers; a new dial after a lost socket waits, and takes the session up again."""


async def gaps_until(robot: Robot, end_s: float) -> list[float]:
    """Echo until *end_s* (Unix seconds); return the seconds between answers."""
    gaps, last = [], time.monotonic()
    while time.time() < end_s:
        assert (await robot.call("echo", {"value": 1}, deadline_s=DEADLINE_S)).reply == {"value": 1}
        gaps.append(time.monotonic() - last)
        last = time.monotonic()
    return gaps


def test_a_session_passes_the_end_of_its_first_token_without_a_gap(tmp_path: Path) -> None:
    """Beside it one whose callable has nothing fresh: its socket does end, so the test can tell."""

    async def run(server: GuardedServer) -> None:
        shown: list[str] = []

        async def fresh() -> str:
            life_s = NEXT_LIFE_S if shown else FIRST_LIFE_S
            shown.append(server.token("renews", ttl_s=life_s))
            return shown[-1]

        over = server.token("stays", ttl_s=FIRST_LIFE_S)

        async def the_same() -> str:
            return over

        first_ends_s = time.time() + FIRST_LIFE_S
        async with connect(server.url, token=fresh) as robot, connect(server.url, token=the_same) as other:
            ended = asyncio.create_task(lost(other))
            gaps = await gaps_until(robot, first_ends_s + AFTER_S)
            await asyncio.wait_for(ended, DEADLINE_S)
            print(
                f"{len(gaps)} echoes over the end of a token, longest gap {max(gaps) * 1e3:.0f} ms; "
                f"load {os.getloadavg()[0]:.1f}"
            )
            assert robot.stats.reconnects == 0
            assert len(shown) == 2, "once to dial, once to renew"
            assert max(gaps) < MAX_GAP_S

    with GuardedServer(tmp_path, workers=1, session={"max_commands_per_s": 0.0}) as server:
        asyncio.run(run(server))
        assert '"defect"' not in server.log


async def lost(robot: Robot) -> None:
    """Return when the socket of *robot* was lost once."""
    while robot.stats.reconnects == 0:
        await robot.call("echo", {"value": 2}, deadline_s=DEADLINE_S)
