"""Works that run together end together."""

from __future__ import annotations

import asyncio

import pytest

from rse_pf.local.together import run_together


async def test_after_a_failure_the_others_are_cancelled_and_have_ended() -> None:
    ended: list[str] = []

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)  # what it takes to end
            ended.append("endless")

    async def failing() -> None:
        await asyncio.sleep(0)
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        await run_together(endless(), failing())
    assert ended == ["endless"]
