"""A server on a full disk cuts a robot off within two seconds of its revocation, and serves the others."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from client_sdk import connect
from rse_pf.auth.roster import DenyList
from rse_pf.errors import RsePfError
from rse_pf.local.disk_watch import DiskWatch, access_control_store
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

CUT_OFF_WITHIN_S = 2.0
GIVE_UP_S = 20.0

Revocation = Callable[[DenyList], DenyList]
REVOCATIONS: dict[str, Revocation] = {
    "disabled": lambda denied: denied.with_robot("default", "lost", time.time()),
    "one token": lambda denied: denied.with_token("default", "lost", "t-1", time.time() + 900.0),
    "all tokens": lambda denied: denied.with_tokens_before("default", "lost", time.time()),
}


@pytest.mark.parametrize("name", REVOCATIONS)
def test_a_robot_is_cut_off_within_two_seconds_on_a_full_disk(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path], name: str
) -> None:
    disk = small_disk("24m")
    DiskWatch(disk, "memory:", emit=lambda event, **details: None).prepare()
    access = access_control_store(disk)

    async def run(server: GuardedServer) -> float:
        refused = asyncio.Event()

        def note_change(what: str, why: str) -> None:
            if what == "refused":
                refused.set()

        async with (
            connect(server.url, token=server.token("lost"), on_change=note_change) as lost,
            connect(server.url, token=server.token("kept")) as kept,
        ):
            for robot in (lost, kept):
                await robot.call("echo", {"value": 1})
            fill(disk)
            began = time.monotonic()
            access.change_deny_list(REVOCATIONS[name])
            await asyncio.wait_for(refused.wait(), GIVE_UP_S)
            took_s = time.monotonic() - began
            with pytest.raises(RsePfError):
                await lost.call("echo", {"value": 1}, deadline_s=0.5)
            assert (await kept.call("echo", {"value": 2})).reply == {"value": 2}
            assert kept.stats.reconnects == 0
        return took_s

    with GuardedServer(disk) as server:
        took_s = asyncio.run(run(server))

    print(f"{name}: refused after {took_s:.2f} s")
    assert took_s < CUT_OFF_WITHIN_S
