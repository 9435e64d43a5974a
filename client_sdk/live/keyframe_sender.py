"""Send the queued keyframes of a robot to a live map: in order, one at a time, until each is acknowledged.

The map server acknowledges a keyframe after the log of the map holds it durably.  Pose queries have
priority: the sender waits, at most 1 s, until no query is open, and keyframes have a byte rate limit.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from client_sdk.commands.answer_types import Answer
from client_sdk.live.keyframe_queue import (
    KeyframeQueue,
    NumberOffset,
    QueuedKeyframe,
    choose_number_offset,
)
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

__all__ = [
    "REFUSALS",
    "KeyframeSender",
    "KeyframeSent",
    "LiveRobot",
    "RobotInMap",
    "fetch_robot_in_map",
    "make_request",
]

_MAX_POSE_WAIT_S = 1.0  # a keyframe waits no longer for open pose queries, which could else block it for ever
_FIRST_PAUSE_S = 0.1  # pause after the first failed attempt to send a keyframe; it doubles with each failure
_MAX_PAUSE_S = 1.0
"""Longest pause between attempts to send a keyframe, so that a server that returns gets it soon."""
_REFUSED_PAUSE_S = 5.0  # pause of the keyframe sender after an error that only an operator can end
REFUSALS = (Forbidden, Unauthorized, UnknownService)
"""Errors with which every keyframe of the robot is refused until an operator changes a right or a setting."""
_KEYFRAME_REFUSALS = (BadRequest, LimitExceeded, InvalidCamera)
"""Errors with which one keyframe is refused for good, because its own content is invalid or too large."""


class LiveRobot(Protocol):
    """The methods of a `client_sdk.robot.Robot` that a live map uses; that module imports this package."""

    async def call(
        self,
        service: str,
        request: Any,
        reply_type: type[Any] | None = None,
        *,
        deadline_s: float | None = None,
        keep: bool = False,
    ) -> Answer:
        """Call a service of the platform and return its answer; raises RsePfError."""

    @property
    def connected(self) -> bool:
        """Whether the robot has a connection to a server now."""

    def subscribe(self, topic: str) -> Any:
        """Return an async iterator over the updates of a topic, as pairs of key and payload."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotInMap:
    """How a live map knows this robot, and what the platform says about the map.

    Attributes:
        name: Name of the robot in the map; empty while the map does not exist.
        next_number: Number that the map expects for the next keyframe of the robot.
        unused_segment: First of the segment numbers that no keyframe of the robot in the map has.
        map_keyframes: Number of keyframes of all robots in the map.
        allows_images: Whether the operator allows robots to store the images of keyframes.
    """

    name: str
    next_number: int
    unused_segment: int
    map_keyframes: int
    allows_images: bool = False


@dataclass(frozen=True, slots=True)
class KeyframeSent:
    """Times of a keyframe that the map has acknowledged.

    Attributes:
        number: The map's number of the keyframe among those of this robot.
        sent_s: Time of the successful attempt to send the keyframe, by the clock of the sender.
        kept_s: Time of the acknowledgement, by the same clock.
    """

    number: int
    sent_s: float
    kept_s: float


async def fetch_robot_in_map(robot: LiveRobot, map_name: str, deadline_s: float) -> RobotInMap:
    """Ask the service ``live-show`` how the live map knows this robot.

    For a map that does not exist the name is empty, and all numbers are 0.

    Raises:
        BadMessage: The reply lacks a field.
        RsePfError: The call failed, or the platform refused it.
    """
    try:
        answer = await robot.call("live-show", {"map": map_name}, deadline_s=deadline_s, keep=True)
    except NotFound:
        return RobotInMap(name="", next_number=0, unused_segment=0, map_keyframes=0)
    reply = answer.reply
    try:
        you = reply["you"]
        return RobotInMap(
            name=str(you["robot"]),
            next_number=int(you["number"]),
            unused_segment=int(you["segment"]),
            map_keyframes=int(reply["keyframes"]),
            allows_images=bool(reply.get("images", False)),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadMessage(
            "the reply of live-show does not say how the map knows this robot", hint="update the server"
        ) from error


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
        on_introduced: Callable[[RobotInMap, NumberOffset], None],
        on_acknowledged: Callable[[KeyframeSent], None],
    ) -> None:
        """Describe the sender; only `introduce` and `run` use the network.

        Args:
            robot: The robot that calls the services; it may connect later.
            map_name: Name of the live map.
            queue: Keyframes to send.
            deadline_s: Deadline of one call.
            bytes_per_s: Rate limit of the keyframes that are sent.
            clock: Monotonic time in seconds.
            on_introduced: Called after each `introduce` with the map's reply and the offset in use.
            on_acknowledged: Called for each acknowledged keyframe with its number and times.
        """
        self.trouble = ""
        """Why the last attempt to send a keyframe failed; empty after a success.

        It is ``code: sentence``, and for a conflict about numbers the sentence alone.
        """
        self.is_refused = False
        """Whether the platform refused the last attempt with one of `REFUSALS`."""
        self.refused_keyframes = 0
        """Number of keyframes that were removed because the map refused their content."""
        self.current_segment = 0
        """The robot's number of the present odometry segment; the `LiveMapper` sets it."""
        self._robot, self._map_name, self._queue = robot, map_name, queue
        self._deadline_s, self._clock = deadline_s, clock
        self._rate_limit = TokenBucket(bytes_per_s, burst=0.0)
        self._on_introduced, self._on_acknowledged = on_introduced, on_acknowledged
        self._has_keyframe, self._is_empty = asyncio.Event(), asyncio.Event()
        self._has_no_pose_query = asyncio.Event()
        self._is_empty.set()
        self._has_no_pose_query.set()
        self._introduction_lock = asyncio.Lock()
        self._is_known_to_map = False

    def notify_added(self) -> None:
        """Wake the sender after a keyframe was added to the queue."""
        self._is_empty.clear()
        self._has_keyframe.set()

    def pause_for_pose_query(self) -> None:
        """Let keyframes wait, because a pose query is open."""
        self._has_no_pose_query.clear()

    def resume_after_pose_query(self) -> None:
        """Let keyframes be sent again, because the pose query was answered."""
        self._has_no_pose_query.set()

    async def wait_empty(self) -> None:
        """Wait until no keyframe is queued."""
        await self._is_empty.wait()

    async def wait_no_pose_query(self) -> None:
        """Wait until no pose query is open."""
        await self._has_no_pose_query.wait()

    async def introduce(self) -> RobotInMap:
        """Ask how the map knows this robot, number the queued keyframes accordingly, and return the reply.

        Keyframes that the map already has are removed from the queue: their acknowledgements were lost.

        Raises:
            RsePfError: The call failed, or the platform refused it.
        """
        async with self._introduction_lock:
            robot_in_map = await fetch_robot_in_map(self._robot, self._map_name, self._deadline_s)
            queue = self._queue
            offset, acknowledged = choose_number_offset(
                queue.offset,
                first_index=queue.first_index,
                first_segment=queue.first().segment if len(queue) else self.current_segment,
                next_index=queue.next_index,
                next_number=robot_in_map.next_number,
                unused_segment=robot_in_map.unused_segment,
            )
            for _ in range(acknowledged):
                queue.remove_first()
            queue.set_offset(offset)
            self._is_known_to_map = bool(robot_in_map.name)
            self._on_introduced(robot_in_map, offset)
        return robot_in_map

    async def run(self) -> None:
        """Send keyframes until cancelled; failed attempts are repeated after a pause.

        A conflict means that robot and map number keyframes differently: the robot asks for its numbers.
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
            self._is_empty.set()
            self._has_keyframe.clear()
            await self._has_keyframe.wait()
        self._is_empty.clear()

    async def _send_first(self) -> None:
        """Send the oldest keyframe, and remove it from the queue once it is acknowledged or refused.

        A failure raises an RsePfError, also the refusal of the keyframe.  Without an offset or a keyframe
        nothing is done.
        """
        queue, offset = self._queue, self._queue.offset
        if offset is None or not len(queue):
            return
        # 1. Wait for the rate limit, and for open pose queries.
        keyframe = await asyncio.to_thread(queue.first)
        await asyncio.sleep(self._rate_limit.spend(len(keyframe.data), self._clock()))
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self.wait_no_pose_query(), _MAX_POSE_WAIT_S)
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
        # 4. Find out whether the map was started again: it then expects a smaller number than the next one.
        if answer.reply.number < number + 1:
            raise Conflict("the map was started again", hint="nothing: the robot renumbers its keyframes")
        if not self._is_known_to_map:
            await self.introduce()  # this keyframe created the map, which has a name for the robot only now


def make_request(map_name: str, keyframe: QueuedKeyframe, offset: NumberOffset) -> KeyframeRequest:
    """Return the request of ``live-keyframe`` for a queued keyframe, with the numbers of the map."""
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
