"""The messages to all open pages: the newest value of each key, and the last rows of each topic.

A message is stored once for all pages.  A browser that reads slowly receives the newest values only, so that
the memory for it is bounded.
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
"""Largest number of pages (browser windows) that are open at the same time."""
# Number of the newest rows of each topic that a new page receives.
_STORED_ROWS = 500
# Largest number of rows that wait for a slow page; above it, the oldest rows are dropped.
_MAX_WAITING = 2000
# Largest number of values that are stored; above it, the oldest value is dropped.
_MAX_KEYS = 2048
# Time without a message, in seconds, after which a page gets an empty message, so that it can detect a lost
# connection.
_HEARTBEAT_S = 5.0


class _Page:
    """The messages that wait for one open page: keys of changed values, and rows."""

    def __init__(self, topics: frozenset[str]) -> None:
        self.topics = topics
        self.newest: dict[tuple[str, str], None] = {}
        self.rows: deque[bytes] = deque(maxlen=_MAX_WAITING)
        self.woken = asyncio.Event()


class Hub:
    """The values and rows of all topics, and the pages that subscribe to them.

    ``refused`` counts pages that were rejected because too many were open.
    """

    def __init__(self) -> None:
        """Start without values, rows and pages."""
        self.refused = 0
        self._values: dict[tuple[str, str], bytes] = {}
        self._rows: dict[str, deque[bytes]] = {}
        self._pages: set[_Page] = set()

    @property
    def pages(self) -> int:
        """The number of open pages."""
        return len(self._pages)

    def watches(self, topic: str) -> bool:
        """Return whether an open page subscribes to *topic*."""
        return any(topic in page.topics for page in self._pages)

    def put(self, topic: str, key: str, value: Any) -> None:
        """Set the value of *key* in *topic*, and send it to the pages that subscribe to the topic."""
        name = (topic, key)
        self._values[name] = _message(topic, key, value)
        if len(self._values) > _MAX_KEYS:
            del self._values[next(iter(self._values))]
        for page in self._pages:
            if topic in page.topics:
                page.newest[name] = None
                page.woken.set()

    def append(self, topic: str, row: Any) -> None:
        """Add *row* to *topic*, and send it to the pages that subscribe.

        Only the last 500 rows are stored.
        """
        message = _message(topic, "", row)
        self._rows.setdefault(topic, deque(maxlen=_STORED_ROWS)).append(message)
        for page in self._pages:
            if topic in page.topics:
                page.rows.append(message)
                page.woken.set()

    async def messages(self, topics: frozenset[str]) -> AsyncGenerator[bytes, None]:
        """Yield the server-sent events of *topics* for one page: stored values and rows, then new ones.

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
    """Return a server-sent event as bytes.

    JSON escapes line breaks, so that a robot's text cannot end the event.
    """
    text = json.dumps({"topic": topic, "key": key, "value": value}, separators=(",", ":"), default=str)
    return f"data: {text}\n\n".encode()
