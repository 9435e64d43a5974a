"""Send a command to the burst function by HTTP: the bytes of the WebSocket, with the same token.

This is the only module of the robot that speaks HTTP in its event loop; `burst_rules` decides whether it
may.  A call ends with exactly one answer or failure, and never later than its deadline.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from random import Random
from urllib.parse import SplitResult, urlsplit

from client_sdk.commands.answer_types import Answer
from client_sdk.network.http_proxy import TunnelRefused, proxy_of
from client_sdk.network.peer_probe import dial, port_of
from client_sdk.network.region_sockets import cancel_all
from client_sdk.offloading.burst_policy import BurstRules, burst_address
from rse_pf.config import BurstSettings
from rse_pf.errors import RsePfError
from rse_pf.wire import SUBPROTOCOLS, Codec, Command, Failure, Result, Welcome

__all__ = ["BURST_SERVICES", "Burst"]

BURST_SERVICES = frozenset({"pnp"})
"""What the burst function answers."""

_SERVER, _COLD = "lambda", "x-rse-pf-cold"
_OK, _UNAUTHORIZED, _FORBIDDEN, _TOO_MANY = 200, 401, 403, 429
_TOKEN_S = 60.0
"""A token from a callable is used for this long; it is signed for longer."""
_IDLE_S = 20.0
_MAX_IDLE = 4
_MAX_HEAD_BYTES = 16384
_MAX_RETRY_AFTER_S = 86400.0
_LONGEST_S = 5.0
"""A call that takes longer has failed."""
_OF_THE_FUNCTION = frozenset({"busy", "quota", "unauthorized", "forbidden", "connect", "bad-message"})
"""Failures of the function, and not of the command; they count for the breaker."""


class _BrokenHttp(Exception):
    """The peer sent what a load balancer does not send, or what we have cannot be sent by HTTP."""


class _Stale(Exception):
    """A connection that was idle is closed already; nothing was sent to anybody."""


@dataclass(frozen=True, slots=True)
class _Response:
    status: int
    headers: dict[str, str]
    body: bytes


@dataclass(slots=True)
class _Idle:
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    since: float


class Burst:
    """The burst function, as one robot uses it."""

    def __init__(
        self,
        *,
        codec: Codec,
        read_token: Callable[[], Awaitable[str | None]],
        own: Callable[[], tuple[str, ssl.SSLContext | None]],
        clock: Callable[[], float],
        random: Random,
        max_answer_bytes: int,
        url: str | None = None,
    ) -> None:
        """Describe the function; nothing is sent yet.

        Args:
            codec: That of the robot's connection.
            read_token: Returns the robot's token, or raises what it means that there is none.
            own: Returns the address of the servers and what the robot trusts there.
            clock: Seconds, monotonic.
            random: Source of the breaker's jitter.
            max_answer_bytes: A longer answer is not read.
            url: Named by the user; None means the one of the last Welcome, and an empty one: none.
        """
        self._codec = codec
        self._read_token = read_token
        self._own = own
        self._clock = clock
        self._random = random
        self._max_answer_bytes = max_answer_bytes
        self._given_url = url
        self._told_url = ""
        self.rules = BurstRules(commands_per_day=BurstSettings().robot_commands_per_day)
        self._default_context: ssl.SSLContext | None = None
        self._token: tuple[float, str] | None = None
        self._idle: dict[str, list[_Idle]] = {}
        self._tasks: set[asyncio.Task[Result | Failure]] = set()

    def heard(self, welcome: Welcome) -> None:
        """Take over what a server says of the function."""
        self._told_url = welcome.burst_url
        if welcome.burst_url:
            self.rules.commands_per_day = max(0, welcome.limits.burst_commands_per_day)

    @property
    def address(self) -> str | None:
        """The address of the function, None if there is none."""
        url = self._told_url if self._given_url is None else self._given_url
        return burst_address(url, self._own()[0]) if url else None

    def expected_s(self, service: str) -> float | None:
        """Return the expected time of an answer in seconds, None if *service* cannot be asked there now."""
        if service not in BURST_SERVICES or self.address is None:
            return None
        now = self._clock()
        return self.rules.expected_s(now) if self.rules.may_send(now) else None

    async def ask(self, command: Command, *, deadline_s: float, why: str) -> Answer | Failure:
        """Return the function's answer to *command*, or a failure after at most *deadline_s*."""
        address, began = self.address, self._clock()
        if address is None or not self.rules.may_send(began):
            return _failure("quota", "the budget of the burst function is spent, or it failed a moment ago")
        try:
            body = self._codec.encode(command)
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint)
        self.rules.sent()
        work = asyncio.get_running_loop().create_task(self._finish(address, body, began))
        self._tasks.add(work)
        work.add_done_callback(self._tasks.discard)
        # It goes on without the caller, so that the time of a late answer is known to the next one.
        done, _ = await asyncio.wait({work}, timeout=deadline_s)
        if not done:
            return _failure("expired", f"the burst function did not answer within {deadline_s:.3f} s")
        ended = work.result()
        if isinstance(ended, Failure):
            return ended
        return Answer(
            reply=ended.reply, source="burst", server=ended.server,
            round_trip_ms=(self._clock() - began) * 1e3, queue_ms=0.0, compute_ms=ended.compute_ms,
            payload_bytes=len(body), why=why,
        )  # fmt: skip

    async def _finish(self, address: str, body: bytes, began: float) -> Result | Failure:
        """Post *body* and tell the rules what came of it, whether or not somebody still waits for it."""
        try:
            ended, is_cold = await asyncio.wait_for(self._post(address, body), _LONGEST_S)
        except asyncio.TimeoutError:
            ended = _failure("connect", f"the burst function did not answer within {_LONGEST_S:g} s")
            is_cold = False
        except BaseException:
            self.rules.withdrawn()
            raise
        now = self._clock()
        if isinstance(ended, Failure) and ended.code in _OF_THE_FUNCTION:
            after_s = min(_MAX_RETRY_AFTER_S, max(0.0, (ended.retry_after_ms or 0.0) / 1e3))
            self.rules.failed(now, retry_after_s=after_s, jitter=self._random.random())
        else:
            self.rules.answered(now, None if is_cold else now - began)
        return ended

    async def close(self) -> None:
        """End what still runs, and close the idle connections."""
        await cancel_all(self._tasks)
        for idle in self._idle.values():
            for connection in idle:
                connection.writer.transport.abort()
        self._idle.clear()

    async def _post(self, address: str, body: bytes) -> tuple[Result | Failure, bool]:
        """Return the answer, and whether an execution had to be started for it."""
        try:
            token = await self._fresh_token()
            if token is None:
                return _failure("unauthorized", "the burst function takes no robot without a token"), False
            response = await self._send(address, token, body)
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint), False
        except (OSError, EOFError, asyncio.LimitOverrunError, _BrokenHttp) as error:
            cause = getattr(error, "strerror", None) or str(error) or type(error).__name__
            return _failure("connect", f"cannot reach the burst function: {cause}"), False
        if response.status == _OK:
            return self._decode(response), response.headers.get(_COLD) == "true"
        if response.status == _UNAUTHORIZED:
            self._token = None
        return _failure_of_status(response), False

    async def _fresh_token(self) -> str | None:
        now = self._clock()
        if self._token is None or now - self._token[0] >= _TOKEN_S:
            token = await self._read_token()
            if token is None:
                return None
            self._token = (now, token)
        return self._token[1]

    def _decode(self, response: _Response) -> Result | Failure:
        wanted = f"application/{SUBPROTOCOLS[self._codec.name]}"
        if response.headers.get("content-type", "") != wanted:
            return _failure("connect", "what answers at the burst function's address is something else")
        try:
            message = self._codec.decode_from_server(response.body)
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint)
        if isinstance(message, Result | Failure):
            return message
        return _failure("bad-message", "the burst function's answer is no answer to a command")

    async def _send(self, address: str, token: str, body: bytes) -> _Response:
        parts = urlsplit(address)
        host = parts.netloc.rpartition("@")[2]
        target = parts.path + (f"?{parts.query}" if parts.query else "")
        text = (
            f"POST {target or '/'} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n"
            f"Content-Type: application/{SUBPROTOCOLS[self._codec.name]}\r\n"
            f"Content-Length: {len(body)}\r\n\r\n"
        )
        try:
            head = text.encode("ascii")
        except UnicodeError as error:
            raise _BrokenHttp("the token holds a letter that HTTP cannot carry") from error
        idle = self._idle.setdefault(f"{parts.scheme}://{host}", [])
        while idle:
            connection = idle.pop()
            if self._clock() - connection.since < _IDLE_S and not connection.reader.at_eof():
                try:
                    return await self._exchange(
                        connection.reader, connection.writer, head + body, idle, is_reused=True
                    )
                except _Stale:
                    continue
            connection.writer.transport.abort()
        context = self._context(host) if parts.scheme == "https" else None
        try:
            reader, writer = await _open_connection(parts, context)
        except ValueError as error:  # such as a..b, which the encoding of names refuses
            raise _BrokenHttp(f"{parts.hostname} cannot be the name of a host") from error
        except TunnelRefused as refused:
            raise refused.error from None
        return await self._exchange(reader, writer, head + body, idle, is_reused=False)

    async def _exchange(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        data: bytes,
        idle: list[_Idle],
        *,
        is_reused: bool,
    ) -> _Response:
        keep = False
        try:
            try:
                writer.write(data)
                await writer.drain()
                head = await reader.readuntil(b"\r\n\r\n")
            except (ConnectionError, asyncio.IncompleteReadError) as error:
                if is_reused and not getattr(error, "partial", b""):
                    raise _Stale from error
                raise
            status, headers = _parse_head(head)
            size = headers.get("content-length", "")
            if not size.isdecimal() or int(size) > self._max_answer_bytes:
                raise _BrokenHttp("an answer without a length, or too long")
            body = await reader.readexactly(int(size))
            keep = headers.get("connection", "").lower() != "close" and len(idle) < _MAX_IDLE
            if keep:
                idle.append(_Idle(reader, writer, self._clock()))
            return _Response(status, headers, body)
        finally:
            if not keep:
                writer.transport.abort()

    def _context(self, host: str) -> ssl.SSLContext:
        own_url, own_context = self._own()
        if own_context is not None and host == urlsplit(own_url).netloc.rpartition("@")[2]:
            return own_context
        if self._default_context is None:
            self._default_context = ssl.create_default_context()
        return self._default_context


async def _open_connection(
    parts: SplitResult, context: ssl.SSLContext | None
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to the host of *parts*, through the proxy of the environment if it has one."""
    host, port = parts.hostname or "", port_of(parts)
    if proxy_of(parts.scheme, host, port) is None:
        return await asyncio.open_connection(host, port, limit=_MAX_HEAD_BYTES, ssl=context)
    tunnel = await asyncio.to_thread(dial, parts, _LONGEST_S)
    name = host if context is not None else None
    return await asyncio.open_connection(
        sock=tunnel, limit=_MAX_HEAD_BYTES, ssl=context, server_hostname=name
    )


def _parse_head(head: bytes) -> tuple[int, dict[str, str]]:
    """Return the status and the headers of a response, names in small letters."""
    first, *lines = head.decode("latin-1").split("\r\n")
    version, _, rest = first.partition(" ")
    if not version.startswith("HTTP/1.") or not rest[:3].isdecimal() or len(rest[:3]) != 3:
        raise _BrokenHttp("this is not HTTP")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon:
            headers[name.strip().lower()] = value.strip()
    return int(rest[:3]), headers


def _failure_of_status(response: _Response) -> Failure:
    """Return what an HTTP status other than 200 means."""
    after = response.headers.get("retry-after", "")
    after_ms = float(after) * 1e3 if after.isdecimal() and len(after) < 9 else None
    problem = f"the burst function answers {response.status}"
    if response.status == _UNAUTHORIZED:
        return _failure("unauthorized", problem)
    if response.status == _FORBIDDEN:
        return _failure("forbidden", problem)
    if response.status == _TOO_MANY or response.status >= 500:
        return _failure("busy", problem, after_ms=after_ms)
    return _failure("connect", problem)


def _failure(code: str, message: str, *, hint: str = "", after_ms: float | None = None) -> Failure:
    return Failure(code=code, message=message, hint=hint, retry_after_ms=after_ms, server=_SERVER)
