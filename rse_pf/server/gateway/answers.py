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

_UNKNOWN = "unknown"
_FREQUENT = ("ok", Busy.code, "stale")
"""Results of which there are hundreds in a second: they are counted, and logged at level debug only."""


class EncodedAnswer(msgspec.Struct, frozen=True):
    """The final answer to a command, and its bytes."""

    queued: QueuedCommand
    message: Result | Failure
    data: bytes


class Answers:
    """Makes and sends the answers of one worker."""

    def __init__(
        self, context: WorkerContext, *, registry: Registry, services: frozenset[str], objects: ObjectRefs
    ) -> None:
        """Answer no command yet.

        Args:
            context: The clocks, log, metrics and settings of the worker.
            registry: The services that `compute` calls.
            services: Names of all services of this server, also installed ones; others share one label.
            objects: Puts stored objects into payloads, and large replies into the store.
        """
        self.objects = objects
        self.with_objects = frozenset(
            service.name
            for service in registry
            if objects.store is not None and takes_objects(service.request_type)
        )
        """Services whose payloads may name stored objects."""
        self.registry = registry
        self._context = context
        self._services = services
        self._monotonic = context.clocks.monotonic
        self._crash = context.crash
        self._logs_frequent = context.log.writes("debug")

    def offer(self, services: frozenset[str]) -> None:
        """Replace the names of all services of this server."""
        self._services = services

    def compute(self, queued: QueuedCommand) -> EncodedAnswer:
        """Call the service and encode its answer.

        This may run in the event loop or in a thread: it changes no state that they share.
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
        """Return the error of a service that does not exist; it names the services that the token allows."""
        owner: RobotConnection = queued.owner
        scopes = () if owner.claims is None else owner.claims.scopes
        offered = [name for name in self.registry.names if scopes_allow(scopes, f"services:{name}")]
        return unknown_service(queued.command.service, offered)

    def _compute_with_objects(self, queued: QueuedCommand) -> EncodedAnswer:
        """Compute the answer of a service whose payload may refer to stored objects; it may block."""
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
        """Encode *message*, whose computation began at *started_s*; runs where `compute` may run.

        Blocks on the object store if the reply is too large for a message.
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
        """Write *answer*, unless its robot has disconnected; count and log it in any case.

        With *counts_cpu* the time of its computation is added to the CPU seconds of its tenant.
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
        weak = _weakness(message)  # logged at the level of failures, since operators look for weak poses
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
        """Send the answer of a sandbox, a job or a live map, which count their CPU seconds themselves."""
        now = self._context.clocks.monotonic()
        if isinstance(message, Result):
            # A job does not say when it began, only how long it took.
            waited_s = (queued.started_s or now - message.compute_ms / 1e3) - queued.received_s
            queue_ms = max(0.0, waited_s) * 1e3
            message = msgspec.structs.replace(
                message, queue_ms=queue_ms, received_s=queued.received_s, sent_s=now
            )
        self.send(self._encode(queued, message), now, counts_cpu=False)

    def send_refusal(self, refusal: RefusedCommand, now: float) -> None:
        """Answer a command that is not computed."""
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
        """Answer a message that is refused before it is decoded.

        Args:
            connection: The connection of the robot.
            envelope: Id and service of its command, None if they cannot be read.
            size_bytes: Length of the message.
            refusal: The reason of the refusal.
            retry_after_ms: Milliseconds after which the robot may send again.
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
        """Count and log a message of *size_bytes* that was answered with *failure* instead of decoded."""
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
        """Encode *message*; blocks for the store if the reply is too large for a message."""
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
    """Return the log fields of a weak pose; empty for every other answer."""
    reply = message.reply if isinstance(message, Result) else None
    if getattr(reply, "verdict", "") != "weak":
        return {}
    return {"verdict": "weak", "reason": str(getattr(reply, "reason", ""))}
