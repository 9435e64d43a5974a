"""The size of log entries is bounded, and so is the number of events that wait for the store."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rse_pf.errors import Busy
from rse_pf.live_map.events import Event, KeyframeAdded, RobotLeft
from rse_pf.server.live_map.map_server.log import LogWriter, SubmittedEvent


class Taker:
    """Records how many events submitted entry has, and applies none."""

    def __init__(self) -> None:
        self.sizes: list[int] = []

    async def apply_entry(self, position: int, batch: list[SubmittedEvent]) -> None:
        self.sizes.append(len(batch))
        for submitted in batch:
            submitted.applied.set_result([])


class Store:
    """Stands for a thread and for a log that writes submitted entry at once."""

    def store(self, act: Callable[[], int]) -> Awaitable[int]:
        async def done() -> int:
            return act()

        return done()

    def write_entry(self, data: bytes) -> int:
        return 1


def keyframe(number: int) -> Event:
    return KeyframeAdded(robot="r", number=number, segment=0, data=b"")


def writer(taker: Taker) -> LogWriter:
    store = cast(Any, Store())
    environment = SimpleNamespace(threads=store, sleep=asyncio.sleep)
    return LogWriter(
        store,
        cast(Any, environment),
        apply_entry=taker.apply_entry,
        on_waiting=lambda is_waiting: None,
        on_lost=lambda reason: None,
    )


async def test_a_keyframe_too_many_is_refused_and_who_leaves_is_not() -> None:
    entries = writer(Taker())
    for number in range(1024):
        entries.submit(keyframe(number))

    with pytest.raises(Busy):
        entries.submit(keyframe(1024))
    entries.submit(RobotLeft(robot="r"))
