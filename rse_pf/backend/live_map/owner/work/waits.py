"""How long an owner waits before it asks a store again that failed."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

__all__ = ["FIRST_RETRY_S", "Sleep", "next_retry_s"]

FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
Sleep = Callable[[float], Coroutine[Any, Any, None]]
"""Waits for seconds."""


def next_retry_s(wait_s: float) -> float:
    """Return how long to wait after a wait of *wait_s* has not helped."""
    return min(_LAST_RETRY_S, 2 * wait_s)
