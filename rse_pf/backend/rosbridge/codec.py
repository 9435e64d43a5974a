"""The JSON of rosbridge v2 as the platform's messages, and back.

A ``call_service`` becomes the command of the platform's own JSON codec, which judges and reads it: the limits
and the cost are those of any robot.  The message of a ``publish`` is judged and passed on as it is; no object
is made of it.

Source:
    The rosbridge v2.0 protocol specification, RobotWebTools/rosbridge_suite, ROSBRIDGE_PROTOCOL.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec

from rse_pf.budget import Budget, check_json, check_size
from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded, ProtocolError, UnsupportedProtocol
from rse_pf.wire import Codec, Command, Failure, Result, arrays
from rse_pf.wire.envelope import Envelope

__all__ = [
    "CODEC",
    "RosbridgeCodec",
    "RosbridgeMessage",
    "RosbridgeOp",
    "ServiceCall",
    "publication",
    "status_of",
]

CODEC = "rosbridge"
"""The name of the codec, in recordings, logs and lists of robots."""

OPS = frozenset(
    (
        "auth", "call_service", "advertise", "unadvertise", "publish", "subscribe", "unsubscribe",
        "set_level", "status",
    )
)  # fmt: skip
_REFUSED = {
    "png": "PNG compression is",
    "cbor": "CBOR is",
    "cbor-raw": "CBOR is",
    "fragment": "fragments are",
    "advertise_service": "services of robots are",
    "unadvertise_service": "services of robots are",
    "service_response": "services of robots are",
}
_MAX_ID_CHARACTERS = 256
_NOTHING = (b"", b"null", b"[]")
_MAX_TIMEOUT_S = 3600.0

Name = Annotated[str, msgspec.Meta(max_length=256)]


class RosbridgeOp(msgspec.Struct, frozen=True):
    """Every field of every operation that is read; the others are ignored."""

    op: Name
    id: str | int | None = None
    service: Name = ""
    args: msgspec.Raw = msgspec.Raw()
    timeout: float | None = None
    topic: Name = ""
    type: Name | None = None
    msg: msgspec.Raw = msgspec.Raw()
    latch: bool | None = None
    throttle_rate: float | None = None
    queue_length: int | None = None
    compression: Name | None = None
    mac: Annotated[str, msgspec.Meta(max_length=65536)] = ""
    level: Any = None


class _Call(msgspec.Struct, frozen=True):
    """What a refusal has to know of a call that is not decoded."""

    op: str
    id: str | int | None = None
    service: Name = ""


@dataclass(frozen=True, slots=True)
class ServiceCall:
    """A call that has no answer yet: the client's id and its spelling of the service."""

    id: str | int | None
    service: str
    is_unread: bool = False


@dataclass(frozen=True, slots=True)
class RosbridgeMessage:
    """One operation.  ``error`` says why it cannot be executed; ``command`` belongs to ``call_service``."""

    op: RosbridgeOp | None
    command: Command | None = None
    error: ProtocolError | None = None


class _Response(msgspec.Struct, frozen=True, omit_defaults=True):
    op: str
    service: str
    values: Any
    result: bool
    id: str | int | None = None


class _Problem(msgspec.Struct, frozen=True):
    code: str
    message: str
    hint: str
    retry_after_ms: float | None


class _Status(msgspec.Struct, frozen=True, omit_defaults=True):
    op: str
    level: str
    msg: str
    id: str | int | None = None
    code: str = ""
    hint: str = ""
    retry_after_ms: float | None = None


class _Publication(msgspec.Struct, frozen=True):
    op: str
    topic: str
    msg: msgspec.Raw


_encode = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
_decode_op = msgspec.json.Decoder(RosbridgeOp).decode
_decode_call = msgspec.json.Decoder(_Call).decode
_UNDECODABLE = (msgspec.DecodeError, RecursionError, UnicodeDecodeError)
_UNENCODABLE = (RecursionError, ValueError, TypeError, OverflowError)


def publication(topic: str, message: bytes) -> bytes:
    """Return the WebSocket message that tells a subscriber of *topic* the JSON *message*."""
    return _encode(_Publication("publish", topic, msgspec.Raw(message)))


class RosbridgeCodec:
    """The codec of one connection; it knows the calls that have no answer yet.

    Attributes:
        calls: By the id of the command that a call became.
    """

    name = CODEC
    is_text = True

    def __init__(self, limits: SessionSettings, inner: Codec) -> None:
        """Read nothing yet.

        Args:
            limits: What is accepted from the other side.
            inner: The platform's codec ``json``, with the same limits.
        """
        self.calls: dict[int, ServiceCall] = {}
        self._inner = inner
        self._budget = Budget.of_messages(limits)
        self._number = 0

    # --- from the robot ------------------------------------------------------------------------

    def decode_from_robot(self, data: bytes) -> Any:
        """Return the `RosbridgeMessage` in *data*; it tells an error instead of raising it."""
        return self._read(data, None)

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> Any:
        """Return the same, None if *data* is longer than *max_bytes*."""
        return None if len(data) > max_bytes else self._read(data, max_bytes)

    def decode_from_server(self, data: bytes) -> Any:
        """Refuse: robots decode with a rosbridge client."""
        raise UnsupportedProtocol("this codec reads robots' messages only", hint="use a rosbridge client")

    def peek(self, data: bytes) -> Envelope | None:
        """Return which call a message is that will be refused without being decoded; None: no call."""
        try:
            call = _decode_call(data)
        except _UNDECODABLE:
            return None
        if call.op != "call_service" or not _is_id(call.id):
            return None
        return Envelope(self.new_call(call.id, call.service, is_unread=True), _service(call.service))

    def new_call(self, identity: str | int | None, service: str, *, is_unread: bool = False) -> int:
        """Return the id of the command that a call of *service* becomes."""
        self._number += 1
        self.calls[self._number] = ServiceCall(identity, service, is_unread)
        return self._number

    def _read(self, data: bytes, max_bytes: int | None) -> RosbridgeMessage:
        try:
            check_size(data, self._budget)
            op = _parse(data)
        except ProtocolError as error:
            return RosbridgeMessage(None, error=error)
        try:
            _check_op(op)
            if op.op == "call_service":
                return RosbridgeMessage(op, self._command(op, max_bytes))
            if op.op == "publish":
                self._check_message(op)
        except ProtocolError as error:
            return RosbridgeMessage(op, error=error)
        return RosbridgeMessage(op)

    def _command(self, op: RosbridgeOp, max_bytes: int | None) -> Command:
        """Return the command that the inner codec reads of a call; raises ProtocolError."""
        args = bytes(op.args)
        parts = [b'{"type":"command","id":0,"service":', _encode(_service(op.service))]
        if args not in _NOTHING:
            parts += (b',"payload":', args)
        if op.timeout is not None and 0 < op.timeout <= _MAX_TIMEOUT_S:
            parts += (b',"deadline_ms":', _encode(op.timeout * 1e3))
        parts.append(b"}")
        message = self._inner.decode_from_robot(b"".join(parts))
        if type(message) is not Command:  # a payload cannot end the object before its end
            raise BadMessage("this is no call of a service", hint="send op, id, service and args")
        return message

    def _check_message(self, op: RosbridgeOp) -> None:
        text = bytes(op.msg)
        if not text:
            raise BadMessage("a publish has no msg", hint="send op, topic and msg")
        check_json(text, self._budget)

    # --- to the robot --------------------------------------------------------------------------

    def encode(self, message: Any) -> bytes:
        """Return *message* as rosbridge has it: a ``service_response`` or a ``status``; raises BadMessage."""
        identity = message.id
        call = None if identity is None else self.calls.get(identity)
        if call is not None and call.is_unread:
            del self.calls[identity]
        try:
            if isinstance(message, Result):
                reply = (
                    {"object": message.object} if message.reply is None and message.object else message.reply
                )
                return _response(call, reply, is_result=True)
            problem = _Problem(message.code, message.message, message.hint, message.retry_after_ms)
            return status_of(message) if call is None else _response(call, problem, is_result=False)
        except _UNENCODABLE as error:
            raise BadMessage(
                f"a reply cannot be encoded: {str(error)[:150]}",
                hint="send numbers, strings, lists and arrays",
            ) from error

    def respond(self, call: ServiceCall, values: Any) -> bytes:
        """Return the answer *values* to a call that the endpoint itself answers."""
        return _response(call, values, is_result=True)

    def status(self, level: str, text: str, identity: str | int | None = None) -> bytes:
        """Return a ``status`` of *level* that says *text* about the message *identity*."""
        return _encode(_Status("status", level, text, identity))


def status_of(failure: Failure, identity: str | int | None = None) -> bytes:
    """Return *failure* as a ``status`` about the message *identity*."""
    hint = f"; {failure.hint}" if failure.hint else ""
    return _encode(
        _Status(
            "status", "error", f"{failure.code}: {failure.message}{hint}", identity, failure.code,
            failure.hint, failure.retry_after_ms,
        )
    )  # fmt: skip


def _response(call: ServiceCall | None, values: Any, *, is_result: bool) -> bytes:
    service, identity = ("", None) if call is None else (call.service, call.id)
    return _encode(_Response("service_response", service, values, is_result, identity))


def _parse(data: bytes) -> RosbridgeOp:
    """Return the operation in *data*; raises BadMessage."""
    try:
        if not data.isascii():
            data.decode()  # it may be a binary frame, and what is passed on is text
        return _decode_op(data)
    except msgspec.ValidationError as error:
        raise BadMessage(str(error)[:200], hint="compare it with docs/rosbridge.md") from error
    except _UNDECODABLE as error:
        raise BadMessage(
            f"not a message of rosbridge: {str(error)[:150]}", hint="send JSON as text, not CBOR"
        ) from error


def _check_op(op: RosbridgeOp) -> None:
    """Raise ProtocolError if an operation is not one of ours."""
    if not _is_id(op.id):
        raise LimitExceeded(f"an id is longer than {_MAX_ID_CHARACTERS} characters", hint="send a shorter id")
    if op.op in _REFUSED:
        raise UnsupportedProtocol(
            f"{_REFUSED[op.op]} not supported here", hint="see docs/rosbridge.md, what is refused"
        )
    if op.op not in OPS:
        raise BadMessage(f"op {op.op[:40]!r} is unknown", hint="see docs/rosbridge.md, what is supported")


def _is_id(identity: str | int | None) -> bool:
    return not isinstance(identity, str) or len(identity) <= _MAX_ID_CHARACTERS


def _service(name: str) -> str:
    """Return the platform's name of a service: ROS puts a slash before it."""
    return name[1:] if name.startswith("/") else name
