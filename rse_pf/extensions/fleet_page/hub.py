"""What the browsers are told, once for all of them: the newest value of each key, and the last events.

A browser that reads slowly gets the newest values only; what it costs is bounded, whatever it does.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import AsyncGenerator
from typing import Any

from rse_pf.errors import Busy

__all__ = ["MAX_PAGES", "Hub"]

MAX_PAGES = 32
"""Browser windows that are open at a time."""
_KEPT = 500
"""Rows of each topic that a new page is told."""
_MAX_WAITING = 2000
"""Rows that wait for a slow page."""
_MAX_KEYS = 2048
_HEARTBEAT_S = 5.0


class _Page:
    """One open page: what waits for it."""

    def __init__(self, topics: frozenset[str]) -> None:
        self.topics = topics
        self.newest: dict[tuple[str, str], None] = {}
        self.rows: deque[bytes] = deque(maxlen=_MAX_WAITING)
        self.woken = asyncio.Event()


class Hub:
    """The values and rows of this process, and the pages that read them."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self.refused = 0
        self._values: dict[tuple[str, str], bytes] = {}
        self._rows: dict[str, deque[bytes]] = {}
        self._pages: set[_Page] = set()

    @property
    def pages(self) -> int:
        """How many pages are open."""
        return len(self._pages)

    def watches(self, topic: str) -> bool:
        """Return whether an open page wants to know of *topic*."""
        return any(topic in page.topics for page in self._pages)

    def put(self, topic: str, key: str, value: Any) -> None:
        """Replace the value of *key* in *topic*."""
        name = (topic, key)
        self._values[name] = _message(topic, key, value)
        if len(self._values) > _MAX_KEYS:
            del self._values[next(iter(self._values))]
        for page in self._pages:
            if topic in page.topics:
                page.newest[name] = None
                page.woken.set()

    def append(self, topic: str, row: Any) -> None:
        """Add one row to *topic*; the oldest rows are forgotten."""
        message = _message(topic, "", row)
        self._rows.setdefault(topic, deque(maxlen=_KEPT)).append(message)
        for page in self._pages:
            if topic in page.topics:
                page.rows.append(message)
                page.woken.set()

    async def messages(self, topics: frozenset[str]) -> AsyncGenerator[bytes, None]:
        """Yield server-sent events of *topics* for one page: all that is known, then what is new.

        Raises:
            Busy: `MAX_PAGES` pages are open already.
        """
        if len(self._pages) >= MAX_PAGES:
            self.refused += 1
            raise Busy(f"{MAX_PAGES} pages are open already", hint="close one of them", retry_after_ms=5000)
        page = _Page(topics)
        self._pages.add(page)
        page.newest = dict.fromkeys(name for name in self._values if name[0] in topics)
        for topic in sorted(topics & self._rows.keys()):
            page.rows.extend(self._rows[topic])
        try:
            yield b"retry: 1000\n\n"
            while True:
                while page.newest or page.rows:
                    if page.rows:
                        yield page.rows.popleft()
                        continue
                    name = next(iter(page.newest))
                    del page.newest[name]
                    if name in self._values:
                        yield self._values[name]
                page.woken.clear()
                try:
                    await asyncio.wait_for(page.woken.wait(), _HEARTBEAT_S)
                except asyncio.TimeoutError:
                    yield b": still here\n\n"
        finally:
            self._pages.discard(page)


def _message(topic: str, key: str, value: Any) -> bytes:
    """Return one server-sent event; JSON has no line break, so that no text of a robot can end it."""
    text = json.dumps({"topic": topic, "key": key, "value": value}, separators=(",", ":"), default=str)
    return f"data: {text}\n\n".encode()
