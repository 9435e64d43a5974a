"""Wait for several coroutines at once, as a task group of Python 3.11 does."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

__all__ = ["run_together"]


async def run_together(*works: Coroutine[Any, Any, Any]) -> None:
    """Wait for all of *works*; after a failure or a cancellation, end the others, too.

    Raises:
        BaseException: What the first of them that failed raised.
    """
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
