"""A client of control ports, over one connection that stays open, so that health checks cost little.

Every request has a time limit, and every failure is a ConnectionError.  A late reply is never taken for the
reply to a later request, since a failure closes the connection.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator
from dataclasses import dataclass
from typing import Any

from rse_pf.auth.control_token import bearer
from rse_pf.errors import UsageError

__all__ = ["ControlPort", "ControlPortReply"]

_LOOPBACK = "127.0.0.1"
# Longest head of a reply, in bytes; a longer one is an error.
_MAX_HEAD_BYTES = 16384
# Longest body of a reply, or line of a stream of events, in bytes; a longer one is an error.
_MAX_BODY_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlPortReply:
    """The reply of a control port: HTTP status and body."""

    status: int
    body: bytes

    def document(self) -> dict[str, Any]:
        """Return the body as a JSON object; an empty one if the body is no JSON object."""
        try:
            document = json.loads(self.body)
        except ValueError:
            return {}
        return document if isinstance(document, dict) else {}


class ControlPort:
    """A client of one control port on this machine.

    It connects at the first request, and again after a failure.  Each request carries *token*; None if the
    port requires none.
    """

    def __init__(self, port: int, token: str | None = None) -> None:
        self._port = port
        self._headers = f"Host: {_LOOPBACK}\r\nContent-Length: 0\r\n"
        if token is not None:
            self._headers += f"Authorization: {bearer(token)}\r\n"
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._lock = asyncio.Lock()

    async def ask(self, target: str, *, timeout_s: float, method: str = "GET") -> ControlPortReply:
        """Send a request for *target* (path and query), and return the reply, of any HTTP status.

        Concurrent calls wait for each other; *timeout_s* begins after that wait.

        Raises:
            ConnectionError: Nobody listens, the reply is no HTTP or too long, or it took more than
                *timeout_s*.
        """
        async with self._lock:
            try:
                return await asyncio.wait_for(self._exchange(method, target), timeout_s)
            except (OSError, EOFError, ValueError, asyncio.LimitOverrunError, asyncio.TimeoutError) as error:
                self.close()
                raise ConnectionError(
                    f"no answer from port {self._port}: {str(error) or type(error).__name__}"
                ) from error
            except BaseException:
                self.close()
                raise

    async def ask_once(
        self, target: str, *, timeout_s: float, method: str = "GET"
    ) -> ControlPortReply | None:
        """Return the reply to one request, or None where `ask` raises; then close the connection."""
        try:
            return await self.ask(target, timeout_s=timeout_s, method=method)
        except ConnectionError:
            return None
        finally:
            self.close()

    async def follow(
        self, target: str, *, silence_s: float, method: str = "POST"
    ) -> AsyncGenerator[dict[str, Any], None]:
        """Request an operation, and yield its events until the port closes the connection.

        Uses a connection of its own.

        Raises:
            UsageError: The port refuses the operation, with its message and hint.
            ConnectionError: Nobody listens, the reply is no HTTP, or no event came for *silence_s* seconds.
        """
        writer: asyncio.StreamWriter | None = None
        try:
            reader, writer = await asyncio.open_connection(_LOOPBACK, self._port, limit=_MAX_BODY_BYTES)
            writer.write(f"{method} {target} HTTP/1.1\r\n{self._headers}Connection: close\r\n\r\n".encode())
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), silence_s)
            status = int(head.split(b" ", 2)[1])
            while line := await asyncio.wait_for(reader.readline(), silence_s):
                event = json.loads(line)
                if status != 200:
                    raise UsageError(
                        str(event.get("message", f"the control plane answers {status}")),
                        hint=str(event.get("hint", "use the rse-pf of the platform's version")),
                    )
                yield event
        except (OSError, EOFError, ValueError, LookupError, asyncio.TimeoutError) as error:
            raise ConnectionError(
                f"no answer from port {self._port}: {str(error) or type(error).__name__}"
            ) from error
        finally:
            if writer is not None:
                writer.close()

    def close(self) -> None:
        """Close the connection, if there is one; the next request connects again."""
        if self._writer is not None:
            self._writer.transport.abort()
        self._reader = self._writer = None

    async def _exchange(self, method: str, target: str) -> ControlPortReply:
        if self._reader is None or self._writer is None:
            self._reader, self._writer = await asyncio.open_connection(
                _LOOPBACK, self._port, limit=_MAX_HEAD_BYTES
            )
        reader, writer = self._reader, self._writer
        writer.write(f"{method} {target} HTTP/1.1\r\n{self._headers}\r\n".encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = dict(line.lower().split(": ", 1) for line in head[1:] if ": " in line)
        length = int(headers["content-length"]) if "content-length" in headers else -1
        if not 0 <= length <= _MAX_BODY_BYTES:
            raise ValueError(f"the reply states a length of {length} bytes, not 0 to {_MAX_BODY_BYTES}")
        body = await reader.readexactly(length)
        if headers.get("connection") == "close":
            self.close()
        return ControlPortReply(status=int(head[0].split(" ")[1]), body=body)
