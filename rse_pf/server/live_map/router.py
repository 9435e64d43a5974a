"""Pass commands of robots to the map servers of live maps, and updates back to the robots of one worker.

The worker checks the scope of the robot's token, and the size and format of each request; the map server
validates its content.
"""

from __future__ import annotations

import asyncio
import traceback
from collections import Counter
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
    LimitExceeded,
    RsePfError,
)
from rse_pf.identity import RobotId
from rse_pf.server.live_map.client import LiveMapClient
from rse_pf.server.live_map.subscriptions import Subscriptions
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueBacklog, QueuedCommand, QueueReport
from rse_pf.server.worker_context import Subscriber, WorkerContext
from rse_pf.service import failure_of
from rse_pf.slam.keyframe import MAX_KEYFRAME_BYTES, check_odometry_range, decode_keyframe
from rse_pf.wire import Failure, Result, as_type
from rse_pf.wire.live_map import (
    FORGET,
    LIVE_REQUESTS,
    PUBLISH,
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
"""Name of the service that lists the live maps of the tenant; the worker answers it from the store."""
LIVE_SERVICES = frozenset((*LIVE_REQUESTS, LIVE_LIST))
"""Names of all services of live maps."""

_OPERATOR_SERVICES = frozenset((PUBLISH, STOP, FORGET, START))
"""Services that need the scope ``maps:write`` of their map.  The others need ``maps:live``; ``live-list``
lists only the maps for which the token has it."""
_MAX_WAITING_BYTES = 64 << 20
"""Largest total size in bytes of the messages of one worker that wait for map servers.  Beyond it, commands
are refused with Busy, and robots keep their keyframes."""
_MAX_WAITING_BYTES_PER_TENANT = _MAX_WAITING_BYTES // 4
"""Largest total size in bytes of the messages of one tenant that wait for map servers in one worker: a
quarter of the total, so that one tenant cannot fill it.  Beyond it, commands of this tenant are refused with
Busy."""
_BUSY_RETRY_MS = 500.0
"""Milliseconds after which a robot sends a command again that was refused because too many wait."""


class LiveMapRouter(CommandQueue):
    """The live maps as the robots of one worker use them: a queue of commands, and subscriptions."""

    checks_scope = True
    """The caller does not check the scope of a command: this class does, since the scope names the map."""

    def __init__(
        self,
        context: WorkerContext,
        *,
        make_client: Callable[[Callable[[str, str, dict[str, Any]], None]], LiveMapClient],
        answer: Callable[[QueuedCommand, Result | Failure], None],
    ) -> None:
        """Prepare; no map server is contacted before the first command or subscription.

        Args:
            context: Context of the worker.
            make_client: Makes the client of the live maps; its argument is called with tenant, map name and
                payload of each update.
            answer: Called once for each submitted command, except for those that `close` cancels.
        """
        self._context = context
        self._monotonic = context.clocks.monotonic
        self._answer = answer
        self._client = make_client(self.update)
        self._tasks: dict[asyncio.Task[None], QueuedCommand] = {}
        self._waiting_bytes = 0
        self._waiting_bytes_of_tenant: Counter[str] = Counter()
        self._waiting_of_robot: Counter[RobotId] = Counter()  # number of commands without an answer
        self._subscriptions = Subscriptions(
            loop=context.loop,
            log=context.log,
            watch=lambda tenant, name, may_start: self._client.watch(tenant, name, may_start=may_start),
            unwatch=self._client.unwatch,
        )

    @property
    def held(self) -> int:
        """Number of commands to live maps that have no answer yet."""
        return len(self._tasks)

    def offers(self, service: str) -> bool:
        """Return whether *service* is a service of live maps."""
        return service in LIVE_SERVICES

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands to live maps of the robot of *queued* have no answer yet."""
        return QueueBacklog(self._waiting_of_robot[queued.robot])

    # --- Commands of robots and operators ---

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Pass a command to the map server of its map; a command that is refused is answered at once.

        *now* is the monotonic time in seconds.
        """
        tenant = queued.robot.tenant
        try:
            tenant_bytes = self._waiting_bytes_of_tenant[tenant] + queued.size_bytes
            worker_bytes = self._waiting_bytes + queued.size_bytes
            if tenant_bytes > _MAX_WAITING_BYTES_PER_TENANT or worker_bytes > _MAX_WAITING_BYTES:
                raise Busy(
                    f"{tenant_bytes} bytes of commands to live maps wait for this tenant, and {worker_bytes} "
                    f"for all; at most {_MAX_WAITING_BYTES_PER_TENANT} and {_MAX_WAITING_BYTES} may wait",
                    hint="send the command again after retry_after_ms",
                    retry_after_ms=_BUSY_RETRY_MS,
                )
            request = self._prepare_request(queued, now)
        except RsePfError as error:
            self._answer_failure(queued, error)
            return
        task = self._context.loop.create_task(self._answer_command(queued, request))
        self._tasks[task] = queued
        self._waiting_bytes = worker_bytes
        self._waiting_bytes_of_tenant[tenant] = tenant_bytes
        self._waiting_of_robot[queued.robot] += 1
        task.add_done_callback(self._on_answered)

    def _prepare_request(self, queued: QueuedCommand, now: float) -> Callable[[], Any]:
        """Check a command and return a function that sends its request and returns the awaitable reply.

        *now* is the monotonic time in seconds.

        Raises:
            RsePfError: The command is refused.
        """
        command, claims = queued.command, queued.owner.claims
        robot, service = queued.robot, command.service
        deadline_s = queued.deadline_s - now
        if service == LIVE_LIST:
            return lambda: self._list_maps(robot.tenant, claims)
        request = _decode_request(service, {} if command.payload is None else command.payload)
        scope = "maps:write" if service in _OPERATOR_SERVICES else "maps:live"
        error = _find_scope_error(claims, scope, request.map)
        if error is None and isinstance(request, LiveStart):
            error = _find_source_error(claims, request)
        if error is not None:
            raise error
        _check_keyframe(request)
        return lambda: self._client.request(robot.tenant, request.map, robot, service, request, deadline_s)

    async def _list_maps(self, tenant: str, claims: Claims | None) -> dict[str, Any]:
        """Return the reply of ``live-list``: the maps of *tenant* for which the token has ``maps:live``."""
        maps = await self._client.list_maps(tenant)
        return {
            "maps": [
                entry
                for entry in maps
                if _find_scope_error(claims, "maps:live", str(entry.get("name"))) is None
            ]
        }

    async def _answer_command(self, queued: QueuedCommand, request: Callable[[], Any]) -> None:
        """Call *request*, which sends the request of a command, and answer the command with its reply.

        Without a reply by the deadline of the command, or after an exception, the answer is a failure.
        """
        started_s = self._monotonic()
        command, server = queued.command, self._context.server_id
        queued.started_s = started_s
        try:
            reply = await asyncio.wait_for(request(), max(0.0, queued.deadline_s - started_s))
        except asyncio.TimeoutError:
            self._answer_failure(
                queued,
                Expired(
                    "the live map did not answer before the deadline of the command",
                    hint="send it again: a command to a live map has its effect only once",
                ),
            )
        except RsePfError as error:
            self._answer_failure(queued, error)
        except Exception as error:  # noqa: BLE001  a defect must not leave the robot without an answer
            text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
            self._context.log.error("defect", service=command.service, trace=command.trace, traceback=text)
            self._answer_failure(
                queued,
                InternalError(
                    "the worker failed on this command to a live map",
                    hint="read the traceback in the server's log",
                ),
            )
        else:
            compute_ms = (self._monotonic() - started_s) * 1e3
            result = Result(
                id=command.id, reply=_decode_matrices(reply), server=server, compute_ms=compute_ms
            )
            self._answer(queued, result)

    def _on_answered(self, task: asyncio.Task[None]) -> None:
        """Subtract a command that was answered from the counts of waiting commands and bytes."""
        queued = self._tasks.pop(task)
        self._waiting_bytes -= queued.size_bytes
        _subtract(self._waiting_bytes_of_tenant, queued.robot.tenant, queued.size_bytes)
        _subtract(self._waiting_of_robot, queued.robot, 1)

    def _answer_failure(self, queued: QueuedCommand, error: RsePfError) -> None:
        self._answer(queued, failure_of(error, queued.command, server=self._context.server_id))

    # --- Subscriptions of robots to updates ---

    def subscribe(self, connection: Any, identity: int, topic: str) -> None:
        """Begin the updates of the live map in *topic* (``live/MAP``), or send the robot an error.

        A token with ``maps:watch`` or ``maps:live`` may read the map; only ``maps:live`` may start a map
        server for it.

        Args:
            connection: Connection of the robot.
            identity: The robot's id of the subscription.
            topic: Topic to which the robot subscribes.
        """
        tenant = connection.robot.tenant
        try:
            map_name = map_of_topic(topic)
            error = _find_reading_error(connection.claims, map_name)
            if error is not None:
                raise error
        except RsePfError as error:
            connection.refuse_updates(identity, error)
            return
        checked_claims = connection.claims

        def find_error() -> RsePfError | None:
            """Check a token that the robot has renewed; return an error if it may not read the map.

            This is called before each update is sent, and checks each token once.  If the token may only
            watch the map, from now on no map server is started for this subscription.
            """
            nonlocal checked_claims
            if connection.claims is checked_claims:
                return None
            checked_claims = connection.claims
            if _find_scope_error(checked_claims, "maps:live", map_name) is not None:
                self._subscriptions.stop_starting(connection, identity)
            return _find_reading_error(checked_claims, map_name)

        self._subscriptions.begin(
            connection,
            identity,
            tenant,
            map_name,
            find_error=find_error,
            may_start=_find_scope_error(checked_claims, "maps:live", map_name) is None,
        )

    def unsubscribe(self, connection: Subscriber, identity: int) -> None:
        """End the subscription with the id *identity* of a robot's connection."""
        self._subscriptions.end(connection, identity)

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Do nothing: a command to a live map cannot be cancelled, and expires at its deadline."""

    def leave(self, owner: Subscriber) -> list[QueuedCommand]:
        """End the subscriptions of a closed connection, and return an empty list: no command is withdrawn.

        Commands of the connection, such as keyframes, are still passed to their map.
        """
        self._subscriptions.end_all(owner)
        return []

    def update(self, tenant: str, map_name: str, payload: dict[str, Any]) -> None:
        """Pass an update of a map server to the subscribers of the map.

        It replaces an older update of the same kind and robot.
        """
        kind, robot = str(payload.get("kind", "")), payload.get("robot")
        key = kind if robot is None else f"{kind}/{robot}"
        self._subscriptions.update(tenant, map_name, key, _decode_matrices(payload))

    # --- Metrics and shutdown ---

    def report(self) -> QueueReport:
        """Return the gauges of live maps in this worker, and the CPU time of its map servers by tenant."""
        subscriptions = self._subscriptions
        return QueueReport(
            gauges={
                "subscriptions": float(len(subscriptions)),
                "updates": float(subscriptions.sent),
                "updates_replaced": float(subscriptions.replaced),
                "live_waiting": float(self.held),
            },
            cpu_s={"live-maps": self._client.cpu_by_tenant()},
        )

    def give_up(self) -> None:
        """Order this worker's map servers to release their maps, because the server drains; does not wait."""
        self._client.give_up()

    def close(self) -> None:
        """Cancel all commands to live maps that have no answer yet; they stay without an answer."""
        for task in list(self._tasks):
            task.cancel()

    async def wait_closed(self) -> None:
        """Cancel all commands, and wait until they have ended and the client of the live maps is closed.

        The maps that this worker's processes serve are released.
        """
        self.close()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._client.close()


def _subtract(counter: Counter[Any], key: Any, number: int) -> None:
    """Subtract *number* from the count of *key*, and remove a count of 0, so that memory stays bounded."""
    counter[key] -= number
    if not counter[key]:
        del counter[key]


def _find_scope_error(claims: Claims | None, scope: str, map_name: str) -> RsePfError | None:
    """Return an error if a token lacks ``SCOPE/MAP``; None if it has it, or if no tokens are required."""
    if claims is None or scopes_allow(claims.scopes, scope, map_name):
        return None
    return Forbidden(
        f"this token does not hold the scope {scope}/{map_name}",
        hint=f"issue a token with the scope {scope}/{map_name}",
    )


def _find_source_error(claims: Claims | None, request: LiveStart) -> RsePfError | None:
    """Return an error if a map starts from a version of another map that the token may not read."""
    source, _ = request.source_version()
    return None if source == request.map else _find_scope_error(claims, "maps:read", source)


def _find_reading_error(claims: Claims | None, map_name: str) -> RsePfError | None:
    """Return an error if a token has neither ``maps:watch`` nor ``maps:live`` for a map, else None."""
    if _find_scope_error(claims, "maps:watch", map_name) is None:
        return None
    return _find_scope_error(claims, "maps:live", map_name)


def _decode_request(service: str, payload: Any) -> LiveRequest:
    """Return the typed request of a command to *service*.

    Raises:
        LimitExceeded: The keyframe is too large.
        BadRequest: The payload is not a valid request.
    """
    if isinstance(payload, dict):
        _check_keyframe_size(payload.get("keyframe"))
    try:
        request: LiveRequest = as_type(payload, LIVE_REQUESTS[service])
    except BadMessage as error:
        raise BadRequest(f"{service}: {error.message}", hint=error.hint) from error
    return request


def _check_keyframe_size(keyframe: Any) -> None:
    """Raise LimitExceeded if an encoded keyframe, as bytes or as base64 text, is too large to decode.

    A *keyframe* of another type, also None, passes.
    """
    size_bytes = 0
    if isinstance(keyframe, str):  # base64: four characters for three bytes, at most two of them padding
        size_bytes = len(keyframe) // 4 * 3 - 2
    elif isinstance(keyframe, bytes | bytearray | memoryview):
        size_bytes = len(keyframe)
    if size_bytes > MAX_KEYFRAME_BYTES:
        raise LimitExceeded(
            f"a keyframe has {size_bytes} bytes, above {MAX_KEYFRAME_BYTES}", hint="send fewer features"
        )


def _check_keyframe(request: LiveRequest) -> None:
    """Raise RsePfError if the keyframe of a request is malformed or implausible; other requests pass.

    The worker decodes keyframes first, because a defect of the decoder in the map server would concern all
    robots of the map.
    """
    if isinstance(request, KeyframeRequest):
        check_odometry_range(decode_keyframe(request.keyframe))
    elif isinstance(request, LiveRelocalise):
        decode_keyframe(request.keyframe)


def _decode_matrices(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of *fields* with poses and covariances as flat float64 arrays in place of bytes.

    Those are the fields ``covariance`` and ``T_...``.  Every codec of the protocol can encode arrays, but
    only the binary one can encode bytes.
    """
    return {
        name: np.frombuffer(value, "<f8")
        if isinstance(value, bytes) and (name.startswith("T_") or name == "covariance")
        else value
        for name, value in fields.items()
    }
