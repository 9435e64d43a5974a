"""Encode the answers to commands, write them to the connections of robots, count them and log them.

Every admitted command is answered here exactly once, whether this worker, a sandbox, a job or a map server
computed it.  Neither a payload nor a token reaches the log.
"""

from __future__ import annotations

import traceback

import msgspec

from rse_pf.auth.roster import scopes_allow
from rse_pf.errors import Busy, InternalError, LimitExceeded, RsePfError, UnknownService
from rse_pf.server.gateway.admission import UnreadRefusal
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.object_refs import ObjectRefs, takes_objects
from rse_pf.server.scheduling.command_queue import QueuedCommand, RefusedCommand
from rse_pf.server.worker_context import WorkerContext
from rse_pf.service import Registry, dispatch, failure_of, unknown_service
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.envelope import Envelope, encode_refusal

__all__ = ["Answers", "EncodedAnswer"]

_UNKNOWN = "unknown"  # name in metrics and log of all services that this server does not offer
# Results that may occur hundreds of times in a second: they are logged at the level debug only.
_FREQUENT = ("ok", Busy.code, "stale")


class EncodedAnswer(msgspec.Struct, frozen=True):
    """The final answer to a command: as a message, and encoded in the codec of its connection."""

    queued: QueuedCommand
    message: Result | Failure
    data: bytes


class Answers:
    """Computes, encodes and sends the answers of one worker to its robots."""

    def __init__(
        self, context: WorkerContext, *, registry: Registry, services: frozenset[str], objects: ObjectRefs
    ) -> None:
        """Answer no command yet.

        Args:
            context: The clocks, log, metrics and settings of the worker.
            registry: The services that `compute` calls.
            services: Names of all services of this server, installed ones included; metrics and log name any
                other service ``unknown``.
            objects: Replaces references in payloads by stored objects, and stores large replies.
        """
        self.objects = objects
        self.with_objects = frozenset(
            service.name
            for service in registry
            if objects.store is not None and takes_objects(service.request_type)
        )
        """Names of the services of the registry whose payloads may refer to stored objects."""
        self.registry = registry
        self._context = context
        self._services = services
        self._monotonic = context.clocks.monotonic
        self._crash = context.crash
        self._logs_frequent = context.log.writes("debug")

    def offer(self, services: frozenset[str]) -> None:
        """Set the names of all services of this server to *services*, since installed services changed."""
        self._services = services

    def compute(self, queued: QueuedCommand) -> EncodedAnswer:
        """Call the service of *queued* and return its encoded answer; an error becomes a Failure.

        This may run in the event loop or in a solver thread: it changes no state that both use.
        """
        before = self._crash.compute_for(queued.owner.number)
        try:
            return self._compute(queued)
        finally:
            self._crash.compute_for(before)

    def _compute(self, queued: QueuedCommand) -> EncodedAnswer:
        command = queued.command
        if command.service in self.with_objects:
            return self._compute_with_objects(queued)
        message = dispatch(
            self.registry, command, self._monotonic, server=self._context.server_id,
            on_defect=self._log_defect, received_s=queued.received_s,
        )  # fmt: skip
        if isinstance(message, Failure) and message.code == UnknownService.code:
            return self._encode_failure(queued, self._unknown_service(queued))
        return self._encode_fitting(queued, message)

    def _unknown_service(self, queued: QueuedCommand) -> RsePfError:
        """Return the error for an unknown service; its hint names the services that the token allows."""
        owner: RobotConnection = queued.owner
        scopes = () if owner.claims is None else owner.claims.scopes
        offered = [name for name in self.registry.names if scopes_allow(scopes, f"services:{name}")]
        return unknown_service(queued.command.service, offered)

    def _compute_with_objects(self, queued: QueuedCommand) -> EncodedAnswer:
        """Resolve the references of *queued* and compute its answer; blocks on the object store."""
        started = self._monotonic()
        try:
            command = self.objects.resolve_references(queued.command, self.registry, queued.owner.robot)
        except RsePfError as error:
            return self._encode_failure(queued, error)
        message = dispatch(
            self.registry,
            command,
            self._monotonic,
            server=self._context.server_id,
            on_defect=self._log_defect,
        )
        return self.encode(queued, message, started)

    def encode(self, queued: QueuedCommand, message: Result | Failure, started_s: float) -> EncodedAnswer:
        """Return the encoded answer *message* to *queued*, for a computation that began at *started_s* (s).

        A Result gets the time in the queue, and the times of arrival and sending.  A reply that is too large
        for a message is stored as an object, which blocks on the object store.
        """
        if isinstance(message, Result):
            message = msgspec.structs.replace(
                message,
                queue_ms=(started_s - queued.received_s) * 1e3,
                received_s=queued.received_s,
                sent_s=self._monotonic(),
            )
        return self._encode_fitting(queued, message)

    def send(self, answer: EncodedAnswer, now: float, *, counts_cpu: bool = True) -> None:
        """Write *answer* to its robot, count it, and log it.

        If the robot has disconnected, the answer is only counted and logged.  Answers of synthetic robots are
        not counted.  Frequent results (`_FREQUENT`) are logged at level debug, except for weak poses.

        Args:
            answer: The encoded answer.
            now: Present time, monotonic seconds.
            counts_cpu: Whether the time of the computation is added to the CPU seconds of the robot's tenant.
        """
        queued, message = answer.queued, answer.message
        if isinstance(message, Result):
            code, computed_s = "ok", message.compute_ms * 1e-3
        else:
            code, computed_s = message.code, now - queued.started_s if queued.started_s else 0.0
        service = self.label(queued.command.service)
        connection: RobotConnection = queued.owner
        if not connection.is_synthetic:
            self._context.metrics.count_answer(
                service, code, now - queued.received_s, queued.robot.tenant, computed_s if counts_cpu else 0.0
            )
        connection.answer(answer.data, queued.command.id)
        connection.tap.observe_answer(answer.data, queued.command, message)
        connection.commands += 1
        connection.last_result = code
        weak = _weakness(message)  # weak poses are logged at the level of failures: operators search for them
        if code in _FREQUENT and not weak and not self._logs_frequent:
            return
        log = self._context.log
        level, write = ("debug", log.debug) if code in _FREQUENT and not weak else ("info", log.info)
        if log.writes(level):
            write(
                "command", robot=queued.robot, service=service, id=queued.command.id,
                trace=queued.command.trace, code=code,
                queue_ms=round((queued.started_s or now) * 1e3 - queued.received_s * 1e3, 3),
                compute_ms=round(message.compute_ms, 3) if isinstance(message, Result) else 0.0,
                bytes_in=queued.size_bytes, bytes_out=len(answer.data), **weak,
            )  # fmt: skip

    def send_message(self, queued: QueuedCommand, message: Result | Failure) -> None:
        """Encode and send the answer of a sandbox, a job or a live map, and log and count it as `send` does.

        No CPU seconds are added: these queues report their own (`QueueReport.cpu_s`).
        """
        now = self._context.clocks.monotonic()
        if isinstance(message, Result):
            # A job reports how long its computation took, and not when it began.
            waited_s = (queued.started_s or now - message.compute_ms / 1e3) - queued.received_s
            queue_ms = max(0.0, waited_s) * 1e3
            message = msgspec.structs.replace(
                message, queue_ms=queue_ms, received_s=queued.received_s, sent_s=now
            )
        self.send(self._encode(queued, message), now, counts_cpu=False)

    def send_refusal(self, refusal: RefusedCommand, now: float) -> None:
        """Send the failure of a command that is refused, and count it under the reason of the refusal."""
        self._context.metrics.shed[refusal.reason] += 1
        self.send(self._encode_failure(refusal.queued, refusal.error), now)

    def refuse_unread(
        self,
        connection: RobotConnection,
        envelope: Envelope | None,
        size_bytes: int,
        refusal: UnreadRefusal,
        retry_after_ms: float,
    ) -> None:
        """Send the failure ``busy`` for a message that is refused before it is decoded, and count it.

        Args:
            connection: The connection of the robot.
            envelope: Id and service of the command, None if they cannot be read; the failure then has no id.
            size_bytes: Length of the message on the wire, for the log.
            refusal: The reason of the refusal, and the text of the failure.
            retry_after_ms: Milliseconds after which the robot may send the command again.
        """
        session = connection.session
        assert session is not None
        failure = Failure(
            id=None if envelope is None else envelope.id, code=Busy.code, message=refusal.message,
            hint=refusal.hint, retry_after_ms=retry_after_ms, server=self._context.server_id,
        )  # fmt: skip
        self._context.metrics.shed[refusal.reason] += 1
        connection.write(encode_refusal(session.codec, failure))
        if envelope is not None:
            self._note_unread(connection, envelope, size_bytes)

    def _note_unread(self, connection: RobotConnection, envelope: Envelope, size_bytes: int) -> None:
        service = self.label(envelope.service)
        if not connection.is_synthetic:
            self._context.metrics.count_answer(service, Busy.code, 0.0)
        if self._logs_frequent:
            self._context.log.debug(
                "command", robot=connection.robot, service=service, id=envelope.id,
                trace="", code=Busy.code, queue_ms=0.0, compute_ms=0.0, bytes_in=size_bytes,
            )  # fmt: skip

    def note_undecoded(self, connection: RobotConnection, failure: Failure, size_bytes: int) -> None:
        """Count and log a message of *size_bytes* that could not be decoded, and was answered by *failure*.

        Without an id in *failure* the message is logged only.
        """
        if failure.id is not None:
            if not connection.is_synthetic:
                self._context.metrics.count_answer(_UNKNOWN, failure.code, 0.0)
            connection.commands += 1
            connection.last_result = failure.code
        self._context.log.info(
            "undecodable", robot=connection.robot, id=failure.id, code=failure.code, reason=failure.message,
            bytes_in=size_bytes,
        )  # fmt: skip

    def label(self, service: str) -> str:
        """Return the name of *service* for metrics and log: ``unknown`` if this server does not offer it."""
        return service if service in self._services else _UNKNOWN

    def _encode_fitting(self, queued: QueuedCommand, message: Result | Failure) -> EncodedAnswer:
        """Return *message* encoded, with its reply as a stored object if it is too large for a message.

        Storing blocks on the object store.  If the reply cannot be stored, the answer is a failure.
        """
        answer = self._encode(queued, message)
        failure = answer.message
        if not isinstance(message, Result) or not isinstance(failure, Failure):
            return answer
        if failure.code != LimitExceeded.code:
            return answer
        stored = self.objects.store_large_reply(message, failure, queued.owner.robot, queued.owner.claims)
        return answer if stored is failure else self._encode(queued, stored)

    def _encode(self, queued: QueuedCommand, message: Result | Failure) -> EncodedAnswer:
        codec, command = queued.owner.session.codec, queued.command
        try:
            data = codec.encode(message)
        except Exception as error:  # noqa: BLE001  the reply of a service may hold anything
            self._log_defect(command, error)
            defect = InternalError(f"the reply of {command.service!r} cannot be encoded")
            return self._encode_failure(queued, defect)
        max_bytes = self._context.settings.session.max_message_bytes
        if len(data) <= max_bytes:
            return EncodedAnswer(queued, message, data)
        if isinstance(message, Result) and message.object and message.reply is not None:
            return self._encode(queued, msgspec.structs.replace(message, reply=None))
        too_large = LimitExceeded(f"the reply has {len(data)} bytes, above {max_bytes}", hint="ask for less")
        return self._encode_failure(queued, too_large)

    def _encode_failure(self, queued: QueuedCommand, error: RsePfError) -> EncodedAnswer:
        failure = failure_of(error, queued.command, server=self._context.server_id)
        return EncodedAnswer(queued, failure, queued.owner.session.codec.encode(failure))

    def _log_defect(self, command: Command, error: BaseException) -> None:
        text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
        self._context.log.error(
            "defect", service=command.service, id=command.id, trace=command.trace, traceback=text
        )


def _weakness(message: Result | Failure) -> dict[str, str]:
    """Return the log fields ``verdict`` and ``reason`` of a weak pose; none for every other answer."""
    reply = message.reply if isinstance(message, Result) else None
    if getattr(reply, "verdict", "") != "weak":
        return {}
    return {"verdict": "weak", "reason": str(getattr(reply, "reason", ""))}
