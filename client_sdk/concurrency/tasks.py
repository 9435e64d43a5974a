"""Wait for asyncio tasks and events without losing a cancellation."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

__all__ = ["cancel_tasks", "wait_for_event"]


async def cancel_tasks(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancel *tasks* and wait until all of them have ended; their exceptions are ignored."""
    cancelled = list(tasks)
    for task in cancelled:
        task.cancel()
    await asyncio.gather(*cancelled, return_exceptions=True)


async def wait_for_event(event: asyncio.Event, timeout_s: float) -> None:
    """Wait until *event* is set, for at most *timeout_s* seconds; a timeout raises nothing.

    `asyncio.wait_for` is not used because it can swallow a cancellation of the waiting task.
    """
    waiting = asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
