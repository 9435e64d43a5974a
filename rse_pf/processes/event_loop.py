"""The event loop of servers: uvloop, which needs half the time of asyncio's own event loop for sockets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from rse_pf.errors import MissingExtra

__all__ = ["event_loop_maker", "run_in_loop"]

_T = TypeVar("_T")


def event_loop_maker() -> Callable[[], asyncio.AbstractEventLoop]:
    """Return the function that makes the event loop of a server; raises MissingExtra without uvloop."""
    try:
        import uvloop
    except ImportError as error:
        raise MissingExtra("uvloop", "backend") from error
    make: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
    return make


def run_in_loop(main: Coroutine[Any, Any, _T]) -> _T:
    """Run *main* in an event loop of uvloop and return its result, as `asyncio.run` does with its own loop.

    Raises:
        MissingExtra: uvloop is not installed.
    """
    loop = event_loop_maker()()
    asyncio.set_event_loop(loop)
    try:
        return loop.run_until_complete(main)
    finally:
        tasks = asyncio.all_tasks(loop)
        for task in tasks:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        loop.run_until_complete(loop.shutdown_default_executor())
        asyncio.set_event_loop(None)
        loop.close()
