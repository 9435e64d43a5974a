"""Send a command to the burst function (AWS Lambda) by HTTP/1.1.

The body of a request has the bytes that the WebSocket would carry, and the token is the same.  `BurstPolicy`
decides whether a command may be sent.  A call of `BurstClient.ask` returns exactly one answer or failure, and
never later than its deadline.  Requests are sent in threads of their own.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import ssl
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from random import Random
from urllib.parse import urlsplit

from client_sdk.commands.answer_types import Answer
from client_sdk.concurrency.tasks import cancel_tasks
from client_sdk.network.dial_errors import DialError
from client_sdk.offloading.burst_policy import MAX_IN_FLIGHT, BurstPolicy, burst_address
from client_sdk.transfer.data_connection import Response, open_connection
from rse_pf.config import BurstSettings
from rse_pf.errors import RsePfError
from rse_pf.wire import SUBPROTOCOLS, Codec, Command, Failure, Result, Welcome

__all__ = ["BURST_SERVICES", "BurstClient"]

BURST_SERVICES = frozenset({"pnp"})
"""Services that the burst function offers."""
SERVER_NAME = "lambda"
"""Field ``server`` of the failures that this module makes: the name that the burst function has in its own
answers, too."""
COLD_START_HEADER = "x-rse-pf-cold"
"""Header of the burst function's answer that is ``true`` after a cold start (AWS Lambda had to start an
environment)."""
TOKEN_REUSE_S = 60.0
"""How long the client of the burst function reuses a signed token, in seconds: signing costs time, and tokens
are valid for minutes."""
IDLE_TIMEOUT_S = 20.0
"""How long an unused HTTP connection to the burst function may be used for another command, in seconds; an
older one is closed instead of used."""
MAX_IDLE_CONNECTIONS = 4
"""Most unused HTTP connections to the host of the burst function that are kept for later commands; a further
one is closed after its command."""
MAX_RETRY_AFTER_S = 86400.0
"""Longest time for which an answer of the burst function can make the robot send it no command, in seconds; a
longer ``Retry-After`` is cut to this."""
EXCHANGE_TIMEOUT_S = 5.0
"""Longest time of one HTTP exchange with the burst function, in seconds; after it, the exchange ends and
counts as a failure of the function.  The caller gets ``expired`` at the deadline of its command, which may be
earlier; the exchange then goes on, so that the policy learns how long a late answer takes."""
FUNCTION_FAILURES = frozenset({"busy", "quota", "unauthorized", "forbidden", "connect", "bad-message"})
"""Error codes that count as failures of the burst function in its circuit breaker: the next command would
probably fail in the same way, because the function is overloaded or unreachable, does not accept this robot,
or sends messages that the robot cannot decode.  Other codes concern the one command."""


@dataclass(frozen=True, slots=True)
class _IdleConnection:
    connection: http.client.HTTPConnection
    since_s: float


class BurstClient:
    """Send commands of one robot to the burst function."""

    def __init__(
        self,
        *,
        codec: Codec,
        read_token: Callable[[], Awaitable[str | None]],
        read_access: Callable[[], tuple[str, ssl.SSLContext | None]],
        clock: Callable[[], float],
        random: Random,
        max_answer_bytes: int,
        url: str | None = None,
    ) -> None:
        """Store the arguments; nothing is sent yet.

        Args:
            codec: Codec of the robot's connection, which encodes the bodies of requests and decodes answers.
            read_token: Returns the robot's token, None without one; raises RsePfError.
            read_access: Returns the WebSocket address of the backend servers, and the TLS context for them.
            clock: Monotonic seconds.
            random: Source of the jitter of the circuit breaker.
            max_answer_bytes: Longest body of an answer, in bytes; a longer one counts as malformed HTTP.
            url: Address of the burst function that the user gave, absolute or a path at the host of the
                servers.  None means the address in the last Welcome of a server, and an empty text means that
                the function is never asked.
        """
        self._codec = codec
        self._read_token = read_token
        self._read_access = read_access
        self._clock = clock
        self._random = random
        self._max_answer_bytes = max_answer_bytes
        self._user_url = url
        self._welcome_url = ""
        self.policy = BurstPolicy(commands_per_day=BurstSettings().robot_commands_per_day)
        self._token: tuple[float, str] | None = None
        self._idle: dict[str, list[_IdleConnection]] = {}
        self._tasks: set[asyncio.Task[Result | Failure]] = set()
        self._threads = ThreadPoolExecutor(MAX_IN_FLIGHT, "rse-pf-burst")

    def read_welcome(self, welcome: Welcome) -> None:
        """Use the address of the burst function and the daily budget of commands that *welcome* states.

        If *welcome* states no address, the address of an earlier Welcome is not used any more, and the budget
        does not change.  An address that the user gave is used in place of any address in a Welcome.
        """
        self._welcome_url = welcome.burst_url
        if welcome.burst_url:
            self.policy.commands_per_day = max(0, welcome.limits.burst_commands_per_day)

    @property
    def address(self) -> str | None:
        """HTTP address of the burst function; None if there is none, or if `burst_address` refuses it."""
        url = self._welcome_url if self._user_url is None else self._user_url
        return burst_address(url, self._read_access()[0]) if url else None

    def expected_s(self, service: str) -> float | None:
        """Return the expected time of an answer in seconds; None if *service* may not be sent now."""
        if service not in BURST_SERVICES or self.address is None:
            return None
        now_s = self._clock()
        return self.policy.expected_s(now_s) if self.policy.may_send(now_s) else None

    async def ask(self, command: Command, *, deadline_s: float, why: str) -> Answer | Failure:
        """Send *command* to the burst function; return an answer or failure within *deadline_s* seconds.

        *why* says why no server was asked or answered; the answer carries this text.  If there is no address,
        or `BurstPolicy.may_send` forbids it, nothing is sent, and the failure ``quota`` is returned.
        """
        address, began_s = self.address, self._clock()
        if address is None or not self.policy.may_send(began_s):
            return _failure("quota", "the budget of the burst function is spent, or it failed a moment ago")
        try:
            body = self._codec.encode(command)
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint)
        self.policy.count_sent()
        exchange = asyncio.get_running_loop().create_task(self._exchange_and_count(address, body, began_s))
        self._tasks.add(exchange)
        exchange.add_done_callback(self._tasks.discard)
        # The exchange goes on after the deadline, so that the policy learns the time of a late answer.
        done, _ = await asyncio.wait({exchange}, timeout=deadline_s)
        if not done:
            return _failure("expired", f"the burst function did not answer within {deadline_s:.3f} s")
        result = exchange.result()
        if isinstance(result, Failure):
            return result
        return Answer(
            reply=result.reply,
            source="burst",
            server=result.server,
            round_trip_ms=(self._clock() - began_s) * 1e3,
            queue_ms=0.0,
            compute_ms=result.compute_ms,
            payload_bytes=len(body),
            why=why,
        )

    async def _exchange_and_count(self, address: str, body: bytes, began_s: float) -> Result | Failure:
        """Post *body*, and count the result in the policy whether or not the caller still waits for it."""
        try:
            result, is_cold = await asyncio.wait_for(self._post(address, body), EXCHANGE_TIMEOUT_S)
        except asyncio.TimeoutError:
            result = _failure("connect", f"the burst function did not answer within {EXCHANGE_TIMEOUT_S:g} s")
            is_cold = False
        except BaseException:
            self.policy.count_withdrawal()
            raise
        now_s = self._clock()
        if isinstance(result, Failure) and result.code in FUNCTION_FAILURES:
            retry_after_s = min(MAX_RETRY_AFTER_S, max(0.0, (result.retry_after_ms or 0.0) / 1e3))
            self.policy.count_failure(now_s, retry_after_s=retry_after_s, jitter=self._random.random())
        else:
            self.policy.count_answer(now_s, None if is_cold else now_s - began_s)
        return result

    async def close(self) -> None:
        """Cancel all exchanges, and close the idle connections."""
        await cancel_tasks(self._tasks)
        for connections in self._idle.values():
            for connection in connections:
                connection.connection.close()
        self._idle.clear()

    async def _post(self, address: str, body: bytes) -> tuple[Result | Failure, bool]:
        """Post an encoded command; return the answer, and whether it is one after a cold start."""
        try:
            token = await self._reuse_token()
            if token is None:
                return _failure("unauthorized", "the burst function takes no robot without a token"), False
            loop = asyncio.get_running_loop()
            response = await loop.run_in_executor(self._threads, self._send, address, token, body)
        except DialError as refused:
            return _failure(refused.error.code, refused.error.message, hint=refused.error.hint), False
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint), False
        except (OSError, ValueError, http.client.HTTPException) as error:
            cause = getattr(error, "strerror", None) or str(error) or type(error).__name__
            return _failure("connect", f"cannot reach the burst function: {cause}"), False
        status, headers, content = response
        if status == 200:
            return self._decode(headers, content), headers.get(COLD_START_HEADER) == "true"
        if status == 401:
            self._token = None
        return _status_failure(status, headers), False

    async def _reuse_token(self) -> str | None:
        now_s = self._clock()
        if self._token is None or now_s - self._token[0] >= TOKEN_REUSE_S:
            token = await self._read_token()
            if token is None:
                return None
            self._token = (now_s, token)
        return self._token[1]

    def _decode(self, headers: http.client.HTTPMessage, content: bytes) -> Result | Failure:
        expected_type = f"application/{SUBPROTOCOLS[self._codec.name]}"
        if headers.get("content-type", "") != expected_type:
            return _failure("connect", "another program answers at the address of the burst function")
        try:
            message = self._codec.decode_from_server(content)
        except RsePfError as error:
            return _failure(error.code, error.message, hint=error.hint)
        if isinstance(message, Result | Failure):
            return message
        return _failure("bad-message", "the burst function sent a message that is no answer to a command")

    def _send(self, address: str, token: str, body: bytes) -> Response:
        """Post *body* on an idle connection that is still open, else on a new one; this function blocks."""
        parts = urlsplit(address)
        headers = {
            "Authorization": f"Bearer {token}",
            "Content-Type": f"application/{SUBPROTOCOLS[self._codec.name]}",
        }
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        host = parts.netloc.rpartition("@")[2]
        idle = self._idle.setdefault(f"{parts.scheme}://{host}", [])
        while idle:
            last = idle.pop()
            if self._clock() - last.since_s < IDLE_TIMEOUT_S:
                # If the peer has closed this connection meanwhile, try the next one.
                with contextlib.suppress(ConnectionError):
                    return self._exchange(last.connection, target, body, headers, idle)
            last.connection.close()
        connection = open_connection(parts, EXCHANGE_TIMEOUT_S, self._tls_context(host))
        return self._exchange(connection, target, body, headers, idle)

    def _exchange(
        self,
        connection: http.client.HTTPConnection,
        target: str,
        body: bytes,
        headers: dict[str, str],
        idle: list[_IdleConnection],
    ) -> Response:
        """Send a request and return the answer; then append the connection to *idle*, or close it.

        It is closed after an error, if the peer wants to close it, and if *idle* is full.
        """
        is_kept = False
        try:
            connection.request("POST", target, body, headers)
            answer = connection.getresponse()
            content = answer.read(self._max_answer_bytes + 1)
            if len(content) > self._max_answer_bytes:
                raise http.client.HTTPException("the answer is too long")
            is_kept = answer.isclosed() and not answer.will_close and len(idle) < MAX_IDLE_CONNECTIONS
            if is_kept:
                idle.append(_IdleConnection(connection, self._clock()))
            return answer.status, answer.headers, content
        finally:
            if not is_kept:
                connection.close()

    def _tls_context(self, host: str) -> ssl.SSLContext | None:
        """Return the TLS context of the backend servers if *host* (``HOST`` or ``HOST:PORT``) is theirs.

        None for any other host: the certificate authorities of the machine are trusted then.
        """
        own_url, own_context = self._read_access()
        return own_context if host == urlsplit(own_url).netloc.rpartition("@")[2] else None


def _status_failure(status: int, headers: http.client.HTTPMessage) -> Failure:
    """Return the failure for an answer of the burst function with an HTTP status other than 200."""
    retry_after = headers.get("retry-after", "")
    is_number = retry_after.isdecimal() and len(retry_after) < 9
    retry_after_ms = float(retry_after) * 1e3 if is_number else None
    problem = f"the burst function answers {status}"
    if status == 401:
        return _failure("unauthorized", problem)
    if status == 403:
        return _failure("forbidden", problem)
    if status == 429 or status >= 500:
        return _failure("busy", problem, retry_after_ms=retry_after_ms)
    return _failure("connect", problem)


def _failure(code: str, message: str, *, hint: str = "", retry_after_ms: float | None = None) -> Failure:
    return Failure(code=code, message=message, hint=hint, retry_after_ms=retry_after_ms, server=SERVER_NAME)
