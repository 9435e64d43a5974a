"""One running driver: its lines on stdin and stdout, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from typing import Any

__all__ = ["Driver", "Missed"]

_LONGEST_LINE = 1 << 20
Event = dict[str, Any]


class Missed(AssertionError):
    """A client did not do what its scenario asks."""


class Driver:
    """``async with Driver(...)``: a process that is killed at the end, with its children."""

    def __init__(self, command: Sequence[str], scenario: str, env: Mapping[str, str], errors: Any) -> None:
        self._command = (*command, scenario)
        self._env, self._errors = {**os.environ, **env}, errors
        self.events: list[dict[str, Any]] = []
        self._more = asyncio.Event()
        self._has_ended = False

    async def __aenter__(self) -> Driver:
        self._process = await asyncio.create_subprocess_exec(
            *self._command, env=self._env, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=self._errors, limit=_LONGEST_LINE, start_new_session=True,
        )  # fmt: skip
        self._reading = asyncio.ensure_future(self._read())
        return self

    async def __aexit__(self, *_: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        await self._process.wait()
        await self._reading

    async def _read(self) -> None:
        stdout = self._process.stdout
        assert stdout is not None
        async for line in stdout:
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict):
                    self.events.append(event)
                    self._more.set()
        self._has_ended = True
        self._more.set()

    def say(self, **order: Any) -> None:
        """Write one line to the driver."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")

    async def until(self, found: Callable[[Event], bool], what: str, within_s: float) -> Event:
        """Return the first event that *found* accepts; raises Missed."""
        try:
            return await asyncio.wait_for(self._find(found, what), within_s)
        except asyncio.TimeoutError:
            raise Missed(f"not within {within_s:g} s: {what}") from None

    async def _find(self, found: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        seen = 0
        while True:
            for event in self.events[seen:]:
                if event.get("event") == "error":
                    raise Missed(f"{what}: {event.get('message')}")
                if found(event):
                    return event
            seen = len(self.events)
            if self._has_ended:
                raise Missed(f"the driver ended before: {what}")
            self._more.clear()
            await self._more.wait()

    async def ready(self, within_s: float = 30.0) -> None:
        """Wait until it is connected."""
        await self.until(lambda event: event.get("event") == "ready", "ready", within_s)

    @property
    def answered(self) -> int:
        """How many answers it last told."""
        return max(
            (each.get("answered", 0) for each in self.events if each.get("event") == "count"), default=0
        )

    async def until_answered(self, count: int, what: str, within_s: float) -> None:
        """Wait until it told that it had so many answers."""
        await self.until(
            lambda event: event.get("event") == "count" and event.get("answered", 0) >= count, what, within_s
        )

    async def done(self, within_s: float = 30.0) -> dict[str, Any]:
        """Return its last line, once it has ended with exit code 0; raises Missed."""
        event = await self.until(lambda event: event.get("event") == "done", "done", within_s)
        try:
            code = await asyncio.wait_for(self._process.wait(), 10)
        except asyncio.TimeoutError:
            raise Missed("the driver does not end after done") from None
        if code != 0:
            raise Missed(f"exit code {code}")
        return event
