"""What a dial is apart from its socket: one more beside a slow one, and what a refusal means.

A dial that began while the network was away hears nothing when it is back: TCP asks again after a second,
then after two more.  So one that is not through soon gets a second one beside it, and the first that is
through wins; the other ends before it says Hello, so that no server ever sees two of a robot.  Promises to
know no WebSocket library, and that no more than two dials of a robot are ever open.

Source:
    RFC 8305 (Happy Eyeballs), Sect. 5: connection attempts start staggered, the first to succeed wins.
"""

from __future__ import annotations

import asyncio
import random as random_module
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar
from urllib.parse import urlsplit

from rse_pf.errors import ConnectError, Forbidden, RsePfError, Unauthorized, UsageError

__all__ = ["Refused", "again_after_s", "dial_beside", "refusal", "shown_address"]

Opened = TypeVar("Opened")

_MAX_RETRY_AFTER_S = 30.0
_SPREAD = 0.2
_BESIDE = 2


class Refused(Exception):
    """A dial that failed: why, how long to wait, and whether trying again is of any use."""

    def __init__(
        self, error: RsePfError, *, after_s: float = 0.0, wrong_address: bool = False, for_good: bool = False
    ) -> None:
        super().__init__(error.message)
        self.error = error
        self.after_s = after_s
        self.wrong_address = wrong_address
        self.for_good = for_good


async def dial_beside(
    dial: Callable[[], Coroutine[Any, Any, Opened]],
    drop: Callable[[Opened], None],
    pause: Callable[[], Awaitable[object]],
    *,
    most: int = 2,
) -> Opened:
    """Return what *dial* opens; where one takes longer than *pause*, a second one begins beside it.

    One that timed out says nothing of the other, which goes on, and gets a new one beside it.  Any other
    failure decides for both: a server that refuses one would refuse the other.

    Args:
        dial: Opens one; cancelled, it leaves nothing open.
        drop: Is given what the other one opened in the same moment.
        pause: Gives what is over when the next one may begin.
        most: So many dials at all; the last failure is raised.
    """
    dials = {asyncio.ensure_future(dial())}
    waiting, begun = asyncio.ensure_future(pause()), 1
    won: asyncio.Future[Opened] | None = None
    try:
        while True:
            is_next = len(dials) < _BESIDE and begun < most
            ends: set[asyncio.Future[Any]] = {*dials, waiting} if is_next else {*dials}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            done = sorted((each for each in dials if each.done()), key=_weight)
            if done and (_weight(done[0]) != _TIMED_OUT or (len(done) == len(dials) and begun == most)):
                won = done[0]
                return won.result()
            dials.difference_update(done)
            if is_next and waiting.done():
                dials.add(asyncio.ensure_future(dial()))
                waiting, begun = asyncio.ensure_future(pause()), begun + 1
            elif not dials:
                return done[-1].result()
    finally:
        waiting.cancel()
        others = [each for each in dials if each is not won]
        for each in others:
            each.cancel()
        for left in await asyncio.gather(*others, return_exceptions=True):
            if not isinstance(left, BaseException):
                drop(left)


_OPENED, _REFUSED, _TIMED_OUT = range(3)


def _weight(dial: asyncio.Future[Any]) -> int:
    """Return what the end of a dial says, the most telling first."""
    error = dial.exception()
    if error is None:
        return _OPENED
    return _TIMED_OUT if isinstance(error, TimeoutError | asyncio.TimeoutError) else _REFUSED


def again_after_s(dial_again_s: float, random: random_module.Random) -> float:
    """Return when a second dial may begin: about *dial_again_s*, and not in step with other robots."""
    return dial_again_s * random.uniform(1.0 - _SPREAD, 1.0 + _SPREAD)


def refusal(address: str, status: int, retry_after: str) -> Refused:
    """Return what an HTTP *status* in place of a WebSocket means; *retry_after* is the header, or empty."""
    if status == 401:
        told = "the token is missing, wrong or over"
        return Refused(Unauthorized(told, hint="issue one: rse-pf token issue ROBOT"), for_good=True)
    if status == 403:
        told = f"{address} forbids this robot to connect"
        return Refused(Forbidden(told, hint="ask the operator"), for_good=True)
    error = ConnectError(f"{address} answers {status}", hint="it is full or not ready; try later")
    if 400 <= status < 500 and status != 429:
        error.hint = "check the URL: it ends with the path of the servers, /ws"
    after_s = float(retry_after) if retry_after.isdecimal() else 0.0
    is_wrong = status in (400, 404)
    return Refused(error, after_s=min(after_s, _MAX_RETRY_AFTER_S), wrong_address=is_wrong)


def shown_address(url: str) -> str:
    """Return *url* as it may be shown, or raise UsageError."""
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = -1
    if parts.scheme not in ("ws", "wss") or not parts.hostname or port == -1:
        raise UsageError(
            f"{url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws or wss://HOST/ws"
        )
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
