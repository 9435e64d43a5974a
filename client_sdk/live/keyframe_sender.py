"""Send the queued keyframes of a robot to a live map: in order, one at a time, until each is acknowledged.

The map server acknowledges a keyframe after the log of the map holds it durably.  Keyframes have a byte rate
limit, and pose queries have priority: each keyframe waits until no query is open, at most 1 s.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from client_sdk.commands.answer_types import Answer
from client_sdk.live.keyframe_queue import (
    KeyframeQueue,
    NumberOffset,
    QueuedKeyframe,
    choose_number_offset,
)
from rse_pf.errors import (
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
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire.live_map import KeyframeKept, KeyframeRequest

__all__ = [
    "REFUSALS",
    "KeyframeSender",
    "KeyframeSent",
    "LiveRobot",
    "MapShown",
    "make_request",
]

_MAX_POSE_WAIT_S = 1.0
"""Longest time for which a keyframe waits until no pose query is open, in seconds; then it is sent in any
case, because a robot that always has an open query would never send one."""
_FIRST_PAUSE_S = 0.1  # pause after the first failed attempt in seconds; it doubles with each failure in a row
_MAX_PAUSE_S = 1.0
"""The pause after a failed attempt does not double beyond this, in seconds, so that a server that returns
gets the keyframe soon; a busy server can ask for a longer pause, and `REFUSALS` have a longer one."""
_REFUSED_PAUSE_S = 5.0  # pause after an error of REFUSALS in seconds: only an operator can end its cause
REFUSALS = (Forbidden, Unauthorized, UnknownService)
"""Errors with which every keyframe of the robot is refused until an operator changes a right or a setting."""
_KEYFRAME_REFUSALS = (BadRequest, LimitExceeded, InvalidCamera)
"""Errors with which one keyframe is refused for its content or size; it is removed, because it would be
refused again."""


class LiveRobot(Protocol):
    """The methods of `client_sdk.robot.Robot` that a live map uses; they are documented there.

    `client_sdk.robot` imports this package, so this package cannot import the class itself.
    """

    async def call(
        self,
        service: str,
        request: Any,
        reply_type: type[Any] | None = None,
        *,
        deadline_s: float | None = None,
        keep: bool = False,
    ) -> Answer:
        """Call a service of the platform and return its answer, as `Robot.call` does; raises RsePfError."""

    @property
    def connected(self) -> bool:
        """Whether the robot has a connection to a server now."""

    def subscribe(self, topic: str) -> Any:
        """Return an async iterator over the updates of a topic, as pairs of key and payload."""


class RobotInMap(msgspec.Struct, frozen=True, kw_only=True):
    """What a live map knows of this robot; the defaults are those of a map that does not exist.

    Attributes:
        robot: Name of the robot in the map; empty while the map does not exist.
        number: Number that the map expects of the next keyframe of this robot.
        segment: The smallest segment number that no keyframe of this robot in the map has.
    """

    robot: str = ""
    number: int = 0
    segment: int = 0


class MapShown(msgspec.Struct, frozen=True, kw_only=True):
    """Reply of the service ``live-show``; the defaults are those of a map that does not exist.

    Attributes:
        you: What the map knows of this robot.
        keyframes: Number of keyframes of all robots in the map.
        images: Whether the operator allows robots to store the images of keyframes (``live.images``).
    """

    you: RobotInMap = RobotInMap()
    keyframes: int = 0
    images: bool = False


@dataclass(frozen=True, slots=True)
class KeyframeSent:
    """Times of a keyframe that the map has acknowledged.

    Attributes:
        number: The map's number of the keyframe; the map numbers those of each robot from 0.
        sent_s: Time of the successful attempt to send the keyframe, by the clock of the sender.
        acknowledged_s: Time of the acknowledgement, by the same clock.
    """

    number: int
    sent_s: float
    acknowledged_s: float


class KeyframeSender:
    """Send queued keyframes to one live map for as long as `run` is not cancelled."""

    def __init__(
        self,
        robot: LiveRobot,
        map_name: str,
        queue: KeyframeQueue,
        *,
        deadline_s: float,
        bytes_per_s: float,
        clock: Callable[[], float],
        current_segment: Callable[[], int],
        on_introduced: Callable[[MapShown, NumberOffset], None],
        on_acknowledged: Callable[[KeyframeSent], None],
    ) -> None:
        """Store the arguments; only `introduce` and `run` use the network.

        Args:
            robot: The robot that calls the services; it may connect later.
            map_name: Name of the live map.
            queue: Keyframes to send.
            deadline_s: Deadline of one call, in seconds.
            bytes_per_s: Rate limit of the keyframes that are sent, in bytes per second.
            clock: Monotonic time in seconds.
            current_segment: Returns the robot's number of the present segment, with which the next keyframe
                is numbered while none is queued.
            on_introduced: Called after each `introduce` with the map's reply and the offset in use.
            on_acknowledged: Called for each acknowledged keyframe with its number and times.
        """
        self.trouble = ""
        """Why the last attempt to send a keyframe failed, as ``code: sentence``; empty after a success.

        After a `Conflict` it is the sentence without the code: the robot corrects its numbers by itself.
        """
        self.is_refused = False
        """Whether the last attempt that failed for another reason than a `Conflict` failed with one of
        `REFUSALS`; False after a success."""
        self.refused_keyframes = 0
        """Number of keyframes that were removed because the map refused their content or size."""
        self._robot, self._map_name, self._queue = robot, map_name, queue
        self._deadline_s, self._clock = deadline_s, clock
        self._rate_limit = TokenBucket(bytes_per_s, burst=0.0)
        self._current_segment = current_segment
        self._on_introduced, self._on_acknowledged = on_introduced, on_acknowledged
        self.is_empty = asyncio.Event()
        """Set while no keyframe is queued."""
        self.has_no_pose_query = asyncio.Event()
        """Set while no pose query is open; the mapper clears it during a query, and keyframes then wait."""
        self._has_keyframe = asyncio.Event()
        self.is_empty.set()
        self.has_no_pose_query.set()
        self._introduction_lock = asyncio.Lock()
        self._is_known_to_map = False

    def notify_added(self) -> None:
        """Wake the sender after a keyframe was added to the queue."""
        self.is_empty.clear()
        self._has_keyframe.set()

    async def introduce(self) -> None:
        """Ask the map for this robot's name and numbers, and set the queue's number offset.

        Queued keyframes that the map already has are removed: their acknowledgements were lost.

        Raises:
            BadMessage: The reply lacks a field.
            RsePfError: The call failed, or the platform refused it.
        """
        async with self._introduction_lock:
            request = {"map": self._map_name}
            try:
                answer = await self._robot.call(
                    "live-show", request, MapShown, deadline_s=self._deadline_s, keep=True
                )
                shown: MapShown = answer.reply
            except NotFound:
                shown = MapShown()
            queue = self._queue
            offset, acknowledged = choose_number_offset(
                queue.offset,
                first_index=queue.first_index,
                first_segment=queue.first().segment if len(queue) else self._current_segment(),
                next_index=queue.next_index,
                next_number=shown.you.number,
                unused_segment=shown.you.segment,
            )
            for _ in range(acknowledged):
                queue.remove_first()
            queue.set_offset(offset)
            self._is_known_to_map = bool(shown.you.robot)
            self._on_introduced(shown, offset)

    async def run(self) -> None:
        """Send the queued keyframes until cancelled; repeat failed attempts after a pause.

        A `Conflict` means that the map expects another number of this robot's next keyframe: `introduce` asks
        for it.
        """
        failures = 0
        while True:
            await self._wait_for_keyframe()
            try:
                if self._queue.offset is None:
                    await self.introduce()
                await self._send_first()
            except Conflict as error:
                failures += 1
                self.trouble = error.message
                if failures > 1:
                    await asyncio.sleep(_backoff_s(failures))
                try:
                    await self.introduce()
                except RsePfError as failure:
                    self.trouble = f"{failure.code}: {failure.message}"
            except RsePfError as error:
                failures += 1
                self.trouble = f"{error.code}: {error.message}"
                self.is_refused = isinstance(error, REFUSALS)
                await asyncio.sleep(_pause_after_s(error, failures))
            else:
                failures, self.trouble, self.is_refused = 0, "", False

    async def _wait_for_keyframe(self) -> None:
        while not len(self._queue):
            self.is_empty.set()
            self._has_keyframe.clear()
            await self._has_keyframe.wait()
        self.is_empty.clear()

    async def _send_first(self) -> None:
        """Send the oldest keyframe, and remove it from the queue when it is acknowledged or refused.

        Without an offset or a keyframe nothing is done.

        Raises:
            BadRequest, LimitExceeded, InvalidCamera: The map refused the keyframe, which was removed.
            Conflict: The map expects another number; it may have acknowledged this keyframe, which was
                removed then.
            RsePfError: The call failed; the keyframe stays in the queue.
        """
        queue, offset = self._queue, self._queue.offset
        if offset is None or not len(queue):
            return
        # 1. Wait for the rate limit, and for open pose queries.
        keyframe = await asyncio.to_thread(queue.first)
        await asyncio.sleep(self._rate_limit.spend(len(keyframe.data), self._clock()))
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self.has_no_pose_query.wait(), _MAX_POSE_WAIT_S)
        # 2. Send the keyframe with the map's number.
        number = offset.number + keyframe.index
        sent_s = self._clock()
        request = make_request(self._map_name, keyframe, offset)
        try:
            answer = await self._robot.call(
                "live-keyframe", request, KeyframeKept, deadline_s=self._deadline_s, keep=True
            )
        except _KEYFRAME_REFUSALS:
            self.refused_keyframes += 1
            queue.remove_first()
            # The map expects numbers without gaps: the next keyframe gets the number of the refused one.
            queue.set_offset(NumberOffset(offset.number - 1, offset.segment))
            raise
        # 3. Remove the acknowledged keyframe from the queue, and report its times.
        queue.remove_first()
        self._on_acknowledged(KeyframeSent(number, sent_s, self._clock()))
        # 4. If the map expects a smaller number next than this keyframe's number + 1, it was started again.
        #    `run` catches this Conflict, shows its sentence in `trouble` and asks for the new numbers.
        if answer.reply.number < number + 1:
            raise Conflict("the map was started again", hint="nothing: the robot renumbers its keyframes")
        if not self._is_known_to_map:
            await self.introduce()  # this keyframe created the map, which has a name for the robot only now


def make_request(map_name: str, keyframe: QueuedKeyframe, offset: NumberOffset) -> KeyframeRequest:
    """Return the request of ``live-keyframe`` for a queued keyframe, with its numbers in the map's count."""
    return KeyframeRequest(
        map=map_name,
        segment=offset.segment + keyframe.segment,
        number=offset.number + keyframe.index,
        keyframe=keyframe.data,
    )


def _pause_after_s(error: RsePfError, failures: int) -> float:
    """Return the pause in seconds before the next attempt, after *failures* failed attempts in a row."""
    if isinstance(error, REFUSALS):
        return _REFUSED_PAUSE_S
    if isinstance(error, _KEYFRAME_REFUSALS):
        return 0.0  # the next attempt sends another keyframe
    retry_after_s = (error.retry_after_ms or 0.0) / 1e3 if isinstance(error, Busy) else 0.0
    return max(retry_after_s, _backoff_s(failures))


def _backoff_s(failures: int) -> float:
    return float(min(_MAX_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(failures - 1, 8)))
