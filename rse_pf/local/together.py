"""Run several coroutines concurrently and wait for all, as a task group of Python 3.11 does."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

__all__ = ["run_together"]


async def run_together(*works: Coroutine[Any, Any, Any]) -> None:
    """Run the coroutines *works* concurrently, and wait until all are done.

    If one of them fails, or the caller is cancelled, all others are cancelled and waited for.

    Raises:
        BaseException: The exception of the coroutine that failed first.
    """
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
