"""Operations of an operator: one at a time, with its events, to its end even if nobody listens any more."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.control.operations import FAILED, OVER, Operations

SOON_S = 10.0


class Kept:
    """Keeps the tasks, as the platform does."""

    def __init__(self) -> None:
        self.tasks: list[asyncio.Task[None]] = []

    def __call__(self, work: Coroutine[Any, Any, None]) -> None:
        self.tasks.append(asyncio.get_running_loop().create_task(work))


async def collected(events: Any) -> list[Any]:
    return [event async for event in events]


async def test_a_failure_is_the_last_event_and_the_next_operation_may_begin() -> None:
    operations = Operations(Kept())

    async def fail() -> None:
        raise ConfigurationError("server-3 did not become healthy", hint="look at its log")

    async def succeed() -> None:
        return

    first = await asyncio.wait_for(collected(operations.begin("roll", fail)), SOON_S)
    second = await asyncio.wait_for(collected(operations.begin("roll", succeed)), SOON_S)
    failed, over = first[-1], second[-1]

    assert failed == {
        "event": FAILED, "message": "server-3 did not become healthy", "hint": "look at its log"
    }  # fmt: skip
    assert over == {"event": OVER}


async def test_a_second_operation_is_refused_and_the_first_goes_on_without_a_listener() -> None:
    kept, go = Kept(), asyncio.Event()
    operations = Operations(kept)
    done = asyncio.Event()

    async def work() -> None:
        await go.wait()
        done.set()

    operations.begin("roll", work)
    with pytest.raises(UsageError, match="'roll' is under way"):
        operations.begin("drain", work)
    go.set()
    await asyncio.wait_for(asyncio.gather(*kept.tasks), SOON_S)
    assert done.is_set()
