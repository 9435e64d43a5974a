"""Bring robots' commands to the owners of live maps, and the owners' updates to the robots of one worker.

The worker judges the right, the size and the form of a command; what it means is judged by the map's owner.
A robot that sends garbage loses the live maps for a while, and nothing else.
"""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rse_pf.auth.roster import scopes_allow
from rse_pf.auth.tokens import Claims
from rse_pf.errors import (
    BadMessage,
    BadRequest,
    Busy,
    Expired,
    Forbidden,
    InternalError,
    InvalidCamera,
    LimitExceeded,
    RsePfError,
)
from rse_pf.identity import RobotId
from rse_pf.server.live_map.garbage import GarbageCounts
from rse_pf.server.live_map.map_link import OwnerLinks
from rse_pf.server.live_map.subscriptions import Subscriptions
from rse_pf.server.ports import Subscriber, WorkerContext
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueReport
from rse_pf.server.scheduling.scheduler import QueueBacklog, QueuedCommand
from rse_pf.service import failure_of
from rse_pf.slam.keyframe import MAX_KEYFRAME_BYTES, check_odometry_range, decode_keyframe
from rse_pf.wire import Failure, Result, as_type
from rse_pf.wire.live_map import (
    FORGET,
    KEYFRAME,
    LIVE_REQUESTS,
    PUBLISH,
    RELOCALISE,
    START,
    STOP,
    KeyframeRequest,
    LiveRelocalise,
    LiveRequest,
    LiveStart,
    map_of_topic,
)

__all__ = ["LIVE_LIST", "LIVE_SERVICES", "LiveMapRouter"]

LIVE_LIST = "live-list"
LIVE_SERVICES = frozenset((*LIVE_REQUESTS, LIVE_LIST))
"""The commands that go to the owner of a live map."""

_FOR_OPERATORS = frozenset((PUBLISH, STOP, FORGET, START))
_MAX_HELD_BYTES = 64 << 20
"""Size of all messages that wait for owners; while a store is slow, robots keep the others."""
_MAX_HELD_OF_TENANT_BYTES = _MAX_HELD_BYTES // 4
_BUSY_RETRY_MS = 500.0
_IS_GARBAGE = (BadRequest.code, BadMessage.code, LimitExceeded.code, InvalidCamera.code)
_JUDGED_BY_OWNER = (KEYFRAME, RELOCALISE)
"""Of these the owner judges the request; its other errors are those of the map, and count against nobody."""


class LiveMapRouter(CommandQueue):
    """The live maps as the robots of one worker see them."""

    judges_scope = True
    """By the name of the map."""

    def __init__(
        self,
        context: WorkerContext,
        *,
        owners: Callable[[Callable[[str, str, dict[str, Any]], None]], OwnerLinks],
        answer: Callable[[QueuedCommand, Result | Failure], None],
    ) -> None:
        """Ask no owner yet.

        Args:
            context: Of the worker.
            owners: Makes the connections to owners; is given what takes an update: tenant, map, payload.
            answer: Called exactly once for each submitted command.
        """
        self._context = context
        self._monotonic = context.clocks.monotonic
        self._answer = answer
        self._owners = owners(self.update)
        self._garbage = GarbageCounts()
        self._tasks: dict[asyncio.Task[None], QueuedCommand] = {}
        self._held_bytes = 0
        self._held_of_tenant: dict[str, int] = {}
        self._waiting: dict[RobotId, int] = {}
        self._subscriptions = Subscriptions(
            loop=context.loop, log=context.log, unwatch=self._owners.unwatch,
            watch=lambda tenant, name, may_start: self._owners.watch(tenant, name, may_start=may_start),
        )  # fmt: skip

    @property
    def held(self) -> int:
        """Commands that have no answer yet."""
        return len(self._tasks)

    def offers(self, service: str) -> bool:
        """Return whether *service* is a command to a live map."""
        return service in LIVE_SERVICES

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands of the robot have no answer yet."""
        return QueueBacklog(self._waiting.get(queued.robot, 0))

    # --- commands ------------------------------------------------------------------------------

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Pass a command to the owner of its map; the answer comes later, or at once if it is refused."""
        try:
            self._check_garbage(queued.robot, now)
            held = self._held_of_tenant.get(queued.robot.tenant, 0) + queued.size_bytes
            if held > _MAX_HELD_OF_TENANT_BYTES or self._held_bytes + queued.size_bytes > _MAX_HELD_BYTES:
                raise Busy(
                    "too many commands wait for live maps", hint="try again later",
                    retry_after_ms=_BUSY_RETRY_MS,
                )  # fmt: skip
            work = self._check_command(queued, now)
        except RsePfError as error:
            if error.code in _IS_GARBAGE:
                self._garbage.note(queued.robot, now)
            self._fail(queued, error)
            return
        task = self._context.loop.create_task(self._follow(queued, work))
        self._tasks[task] = queued
        self._held_bytes += queued.size_bytes
        self._held_of_tenant[queued.robot.tenant] = held
        self._waiting[queued.robot] = self._waiting.get(queued.robot, 0) + 1
        task.add_done_callback(self._done)

    def _check_command(self, queued: QueuedCommand, now: float) -> Callable[[], Any]:
        """Return a function that asks the owner; raises RsePfError if the request is refused."""
        command, claims = queued.command, queued.owner.claims
        robot, service = queued.robot, command.service
        deadline_s = queued.deadline_s - now
        if service == LIVE_LIST:
            return lambda: self._list(robot.tenant, claims)
        request = _request_of(service, {} if command.payload is None else command.payload)
        right = "maps:write" if service in _FOR_OPERATORS else "maps:live"
        forbidden = _forbidden(claims, right, request.map)
        if forbidden is None and isinstance(request, LiveStart):
            forbidden = _forbidden_source(claims, request)
        if forbidden is not None:
            raise forbidden
        _check_keyframe(request)
        return lambda: self._owners.request(robot.tenant, request.map, robot, service, request, deadline_s)

    async def _list(self, tenant: str, claims: Claims | None) -> dict[str, Any]:
        """Return the maps of a tenant that a robot may enter."""
        maps = await self._owners.list_maps(tenant)
        return {
            "maps": [each for each in maps if _forbidden(claims, "maps:live", str(each.get("name"))) is None]
        }

    async def _follow(self, queued: QueuedCommand, work: Callable[[], Any]) -> None:
        """Answer one command with what its owner says, within its deadline."""
        started = self._monotonic()
        command, server = queued.command, self._context.server_id
        queued.started_s = started
        try:
            reply = await asyncio.wait_for(work(), max(0.0, queued.deadline_s - started))
        except asyncio.TimeoutError:
            late = Expired("the live map did not answer in time", hint="send it again: nothing counts twice")
            self._fail(queued, late)
        except RsePfError as error:
            if command.service in _JUDGED_BY_OWNER and error.code in _IS_GARBAGE:
                self._garbage.note(queued.robot, self._monotonic())
            self._fail(queued, error)
        except Exception as error:  # noqa: BLE001  a defect must not leave the robot without an answer
            text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
            self._context.log.error("defect", service=command.service, trace=command.trace, traceback=text)
            self._fail(queued, InternalError("the live map failed", hint="see the server's log"))
        else:
            compute_ms = (self._monotonic() - started) * 1e3
            result = Result(id=command.id, reply=_with_arrays(reply), server=server, compute_ms=compute_ms)
            self._answer(queued, result)

    def _done(self, task: asyncio.Task[None]) -> None:
        queued = self._tasks.pop(task)
        tenant = queued.robot.tenant
        self._held_bytes -= queued.size_bytes
        self._held_of_tenant[tenant] -= queued.size_bytes
        if not self._held_of_tenant[tenant]:
            del self._held_of_tenant[tenant]
        left = self._waiting.pop(queued.robot) - 1
        if left:
            self._waiting[queued.robot] = left

    def _fail(self, queued: QueuedCommand, error: RsePfError) -> None:
        self._answer(queued, failure_of(error, queued.command, server=self._context.server_id))

    def _check_garbage(self, robot: RobotId, now: float) -> None:
        left_s = self._garbage.cut_off_s(robot, now)
        if left_s > 0:
            self._context.metrics.shed["live-garbage"] += 1
            raise Forbidden(
                f"this robot sent too many invalid requests to live maps; they are closed to it for "
                f"{left_s:.0f} s",
                hint="update the robot's SDK, or correct what it sends",
            )

    # --- updates -------------------------------------------------------------------------------

    def subscribe(self, connection: Any, identity: int, topic: str) -> None:
        """Begin the updates of a live map for a robot's connection, or refuse them."""
        tenant, reader = connection.robot.tenant, connection
        try:
            map_name = map_of_topic(topic)
            forbidden = _forbidden_to_read(connection.claims, map_name)
            if forbidden is not None:
                raise forbidden
        except RsePfError as error:
            connection.refuse_updates(identity, error)
            return
        judged = connection.claims

        def may_go_on() -> RsePfError | None:
            nonlocal judged
            if connection.claims is judged:
                return None
            judged = connection.claims
            if _forbidden(judged, "maps:live", map_name) is not None:
                self._subscriptions.stop_starting(reader, identity)
            return _forbidden_to_read(judged, map_name)

        self._subscriptions.begin(
            reader, identity, tenant, map_name, may_go_on=may_go_on,
            may_start=_forbidden(judged, "maps:live", map_name) is None,
        )  # fmt: skip

    def unsubscribe(self, connection: Subscriber, identity: int) -> None:
        """End a subscription."""
        self._subscriptions.end(connection, identity)

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Do nothing: the owner of the map answers before the deadline."""

    def leave(self, owner: Subscriber) -> list[QueuedCommand]:
        """Forget the subscriptions of a connection that ended; its keyframes go on to their map."""
        self._subscriptions.left(owner)
        return []

    def update(self, tenant: str, map_name: str, payload: dict[str, Any]) -> None:
        """Take an update of an owner; ``key`` is that of "latest wins" and no part of the payload."""
        told = _with_arrays(payload)
        kind, robot = str(told.get("kind", "")), told.get("robot")
        key = told.pop("key", None) or (kind if robot is None else f"{kind}/{robot}")
        self._subscriptions.update(tenant, map_name, str(key), told)

    # --- the whole -----------------------------------------------------------------------------

    def report(self) -> QueueReport:
        """Return the gauges of this worker, and the processor time of the owners that it started."""
        subscriptions = self._subscriptions
        return QueueReport(
            gauges={
                "subscriptions": float(len(subscriptions)),
                "updates": float(subscriptions.sent),
                "updates_replaced": float(subscriptions.replaced),
                "live_waiting": float(self.held),
            },
            cpu_s={"live-maps": self._owners.cpu_by_tenant()},
        )

    def give_up(self) -> None:
        """Leave the maps of this server to others: it drains."""
        self._owners.give_up()

    def close(self) -> None:
        """End what waits."""
        for task in list(self._tasks):
            task.cancel()

    async def wait_closed(self) -> None:
        """Close, wait for what waited, and end the connections to owners."""
        self.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._owners.close()


def _forbidden(claims: Claims | None, right: str, map_name: str) -> RsePfError | None:
    """Return why a token does not give *right* on a map; None if it does, or if none is required."""
    if claims is None or scopes_allow(claims.scopes, right, map_name):
        return None
    return Forbidden(f"this token does not hold the scope {right}/{map_name}", hint="issue one that does")


def _forbidden_source(claims: Claims | None, request: LiveStart) -> RsePfError | None:
    """Return why a token does not allow to begin a map with another one: who starts it, may read it then."""
    source, _ = request.source_version()
    return None if source == request.map else _forbidden(claims, "maps:read", source)


def _forbidden_to_read(claims: Claims | None, map_name: str) -> RsePfError | None:
    """Return why a token does not allow to subscribe to a map: who may drive there may, too."""
    if _forbidden(claims, "maps:watch", map_name) is None:
        return None
    return _forbidden(claims, "maps:live", map_name)


def _request_of(service: str, payload: Any) -> LiveRequest:
    """Return the typed request of a command.

    Raises:
        RsePfError: It is too long, or not valid.
    """
    if isinstance(payload, dict):
        _check_size(payload.get("keyframe"), "a keyframe is", MAX_KEYFRAME_BYTES)
    try:
        request: LiveRequest = as_type(payload, LIVE_REQUESTS[service])
    except BadMessage as error:
        raise BadRequest(f"{service}: {error.message}", hint=error.hint) from error
    return request


def _check_size(value: Any, what: str, most: int) -> None:
    """Raise LimitExceeded if bytes are too long, before anything is made from them."""
    size = 0
    if isinstance(value, str):  # base64: four characters for three bytes
        size = len(value) // 4 * 3 - 2
    elif isinstance(value, bytes | bytearray | memoryview):
        size = len(value)
    if size > most:
        raise LimitExceeded(f"{what} {size} bytes, above {most}", hint="send fewer features")


def _check_keyframe(request: LiveRequest) -> None:
    """Raise RsePfError for a keyframe that is garbage: the owner, which others share, decodes none."""
    if isinstance(request, KeyframeRequest):
        check_odometry_range(decode_keyframe(request.keyframe))
    elif isinstance(request, LiveRelocalise):
        decode_keyframe(request.keyframe)


def _with_arrays(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return *values* with matrices that came as bytes as arrays, which every codec can encode."""
    return {
        name: np.frombuffer(value, "<f8")
        if isinstance(value, bytes) and (name.startswith("T_") or name == "covariance")
        else value
        for name, value in values.items()
    }
