"""Send the keyframes of a robot to a live map: in order, one at a time, each until the map keeps it.

Poses come first: a keyframe starts only when no pose is asked for (or after a second of that), and keyframes
take a bounded share of the link.  The map acknowledges a keyframe when it is durable.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from client_sdk.commands.answer_types import Answer
from client_sdk.live.waiting_keyframes import Base, WaitingKeyframe, WaitingKeyframes, rebase
from rse_pf.errors import (
    BadMessage,
    BadRequest,
    Busy,
    Conflict,
    Forbidden,
    InvalidCamera,
    LimitExceeded,
    NotFound,
    RsePfError,
    Unauthorized,
    UnknownService,
)
from rse_pf.token_bucket import TokenBucket
from rse_pf.wire.live_map import KeyframeKept, KeyframeRequest

__all__ = ["REFUSALS", "KeyframeSender", "LiveRobot", "Myself", "ask_map", "keyframe_request"]

_MAX_QUIET_WAIT_S = 1.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 1.0
_REFUSED_PAUSE_S = 5.0
REFUSALS = (Forbidden, Unauthorized, UnknownService)
"""No keyframe will be kept until an operator changes something."""
_WORTHLESS = (BadRequest, LimitExceeded, InvalidCamera)
"""The keyframe itself is refused: no later attempt can succeed."""


class LiveRobot(Protocol):
    """What a live map needs of a `client_sdk.robot.Robot`, which imports this package."""

    async def call(
        self, service: str, request: Any, reply_type: type[Any] | None = None, *,
        deadline_s: float | None = None, keep: bool = False,
    ) -> Answer:  # fmt: skip
        """Call a service of the platform."""

    @property
    def connected(self) -> bool:
        """Whether there is a connection to a server now."""

    def subscribe(self, topic: str) -> Any:
        """Return an async iterator of keys and payloads."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Myself:
    """How a map knows this robot: its name, the number of its next keyframe, a segment that is not in use."""

    robot: str
    number: int
    segment: int
    keyframes: int
    """Of the whole map."""
    images: bool = False
    """Whether the platform allows images of keyframes."""


async def ask_map(robot: LiveRobot, name: str, deadline_s: float) -> Myself:
    """Return how the map *name* knows this robot; raises RsePfError."""
    try:
        answer = await robot.call("live-show", {"map": name}, deadline_s=deadline_s, keep=True)
    except NotFound:
        return Myself(robot="", number=0, segment=0, keyframes=0)
    reply = answer.reply
    try:
        you = reply["you"]
        return Myself(
            robot=str(you["robot"]),
            number=int(you["number"]),
            segment=int(you["segment"]),
            keyframes=int(reply["keyframes"]),
            images=bool(reply.get("images", False)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadMessage(
            "the reply of live-show does not say how the map knows this robot", hint="update the server"
        ) from error


class KeyframeSender:
    """Sends what waits until it is cancelled."""

    def __init__(
        self,
        robot: LiveRobot,
        name: str,
        waiting: WaitingKeyframes,
        *,
        deadline_s: float,
        bytes_per_s: float,
        clock: Callable[[], float],
        on_known: Callable[[Myself, Base], None],
        on_sent: Callable[[int, float, float], None],
    ) -> None:
        """Describe the sender; `run` sends.

        Args:
            robot: A connected robot, or one that will be.
            name: Of the map.
            waiting: The keyframes.
            deadline_s: Of one attempt.
            bytes_per_s: Share of the link that keyframes may take.
            clock: Seconds, monotonic.
            on_known: Called when the map has said how it knows this robot.
            on_sent: Called for each keyframe that is kept: its number in the map, and the times of sending
                and of the acknowledgement.
        """
        self.trouble = ""
        """Why the oldest keyframe is not kept yet; empty if there is no trouble."""
        self.is_refused = False
        self.sent = 0
        self.refused = 0
        self.current_segment = 0
        """Of the keyframes that will be made; the owner of this sender sets it."""
        self._robot, self._name, self._waiting = robot, name, waiting
        self._deadline_s, self._clock = deadline_s, clock
        self._bucket = TokenBucket(bytes_per_s, burst=0.0)
        self._on_known, self._on_sent = on_known, on_sent
        self._added, self._empty, self._quiet = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._empty.set()
        self._quiet.set()
        self._one_introduction = asyncio.Lock()
        self._is_known = False

    def note_added(self) -> None:
        """Take that a keyframe was added."""
        self._empty.clear()
        self._added.set()

    def note_pose_asked(self) -> None:
        """Take that a pose is asked for: keyframes wait."""
        self._quiet.clear()

    def note_pose_answered(self) -> None:
        """Take that no pose is asked for any more."""
        self._quiet.set()

    async def wait_empty(self) -> None:
        """Wait until the map has every keyframe."""
        await self._empty.wait()

    async def wait_quiet(self) -> None:
        """Wait until no pose is asked for."""
        await self._quiet.wait()

    async def introduce(self) -> Myself:
        """Ask how the map knows this robot, and number the waiting keyframes by it; raises RsePfError."""
        async with self._one_introduction:
            myself = await ask_map(self._robot, self._name, self._deadline_s)
            self._number_by(myself)
        return myself

    async def run(self) -> None:
        """Send until cancelled."""
        failures = 0
        while True:
            await self._wait_for_work()
            try:
                if self._waiting.base is None:
                    await self.introduce()
                await self._send_first()
            except Conflict as error:
                failures += 1
                self.trouble = error.message
                if failures > 1:
                    await asyncio.sleep(_pause_s(failures))
                await self._introduce_again()
            except RsePfError as error:
                failures += 1
                self.trouble = f"{error.code}: {error.message}"
                self.is_refused = isinstance(error, REFUSALS)
                await asyncio.sleep(_pause_after(error, failures))
            else:
                failures, self.trouble, self.is_refused = 0, "", False

    def _number_by(self, myself: Myself) -> None:
        """Number the waiting keyframes as the map expects them."""
        waiting = self._waiting
        segment = waiting.first().segment if len(waiting) else self.current_segment
        base, known = rebase(
            waiting.base,
            Base(waiting.first_index, segment),
            waiting.next_index,
            Base(myself.number, myself.segment),
        )
        for _ in range(known):
            waiting.remove_first()
        waiting.set_base(base)
        self._is_known = bool(myself.robot)
        self._on_known(myself, base)

    async def _wait_for_work(self) -> None:
        while not len(self._waiting):
            self._empty.set()
            self._added.clear()
            await self._added.wait()
        self._empty.clear()

    async def _introduce_again(self) -> None:
        try:
            await self.introduce()
        except RsePfError as error:
            self.trouble = f"{error.code}: {error.message}"

    async def _send_first(self) -> None:
        waiting, base = self._waiting, self._waiting.base
        if base is None or not len(waiting):
            return
        keyframe = await asyncio.to_thread(waiting.first)
        await asyncio.sleep(self._bucket.spend(len(keyframe.data), self._clock()))
        await self._wait_quiet()
        number = base.number + keyframe.index
        sent_s = self._clock()
        request = keyframe_request(self._name, keyframe, base)
        try:
            answer = await self._robot.call(
                "live-keyframe", request, KeyframeKept, deadline_s=self._deadline_s, keep=True
            )
        except _WORTHLESS:
            self.refused += 1
            waiting.remove_first()
            waiting.set_base(Base(base.number - 1, base.segment))  # the map counts without gaps
            raise
        self.sent += 1
        waiting.remove_first()
        self._on_sent(number, sent_s, self._clock())
        if answer.reply.number < number + 1:
            raise Conflict("the map began anew", hint="nothing to do: the robot numbers its keyframes again")
        if not self._is_known:
            await self.introduce()  # the first keyframe began the map, which has a name for this robot now

    async def _wait_quiet(self) -> None:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self.wait_quiet(), _MAX_QUIET_WAIT_S)


def keyframe_request(name: str, keyframe: WaitingKeyframe, base: Base) -> KeyframeRequest:
    """Return the request of ``live-keyframe`` to the map *name*, which numbers keyframes by *base*."""
    return KeyframeRequest(
        map=name, segment=base.segment + keyframe.segment, number=base.number + keyframe.index,
        keyframe=keyframe.data,
    )  # fmt: skip


def _pause_after(error: RsePfError, failures: int) -> float:
    """Return how long to wait before the next attempt."""
    if isinstance(error, REFUSALS):
        return _REFUSED_PAUSE_S
    if isinstance(error, _WORTHLESS):
        return 0.0
    asked_s = (error.retry_after_ms or 0.0) / 1e3 if isinstance(error, Busy) else 0.0
    return max(asked_s, _pause_s(failures))


def _pause_s(failures: int) -> float:
    return float(min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(failures - 1, 8)))
