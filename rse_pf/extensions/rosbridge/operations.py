"""Decode the operations of rosbridge v2, and encode the answers to clients.

The message of a ``publish`` is only checked, and passed on as the same JSON text without decoding.

Source:
    The rosbridge v2.0 protocol specification, RobotWebTools/rosbridge_suite, ROSBRIDGE_PROTOCOL.md.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

import msgspec

from rse_pf.errors import BadMessage, RsePfError, UnsupportedProtocol
from rse_pf.limits.budget import Budget, check_json, check_size
from rse_pf.wire import arrays

__all__ = ["Head", "Operation", "publication", "read_head", "read_operation", "refusal", "response"]

# The supported values of ``op``.
OPS = frozenset(
    (
        "auth", "call_service", "advertise", "unadvertise", "publish", "subscribe", "unsubscribe",
        "set_level", "status",
    )
)  # fmt: skip
# Values of ``op`` in the rosbridge specification that are not supported: subject and verb of the error
# message.
_UNSUPPORTED = {
    "png": "PNG compression is",
    "cbor": "CBOR is",
    "cbor-raw": "CBOR is",
    "fragment": "fragments are",
    "advertise_service": "services of robots are",
    "unadvertise_service": "services of robots are",
    "service_response": "services of robots are",
}
# Hint of errors about malformed operations.
_PAGE = "compare it with docs/rosbridge.md"

Name = Annotated[str, msgspec.Meta(max_length=256)]
# The id of an operation, which its answer repeats.
Identity = Annotated[str, msgspec.Meta(max_length=256)] | int | None


class Head(msgspec.Struct, frozen=True):
    """The fields of a rejected message that the answer repeats: operation, id, and service of a call."""

    op: Any = None
    id: Any = None
    service: Any = None


class Operation(msgspec.Struct, frozen=True):
    """An operation of a client: the fields of all operations; unknown fields are ignored."""

    op: Name
    id: Identity = None
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


class _Response(msgspec.Struct, frozen=True, omit_defaults=True):
    op: str
    service: str
    values: Any
    result: bool
    id: str | int | None = None


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
_decode = msgspec.json.Decoder(Operation).decode
# Exceptions of a message that cannot be decoded.
_UNDECODABLE = (msgspec.DecodeError, RecursionError, ValueError)
# Exceptions of a value that cannot be encoded as JSON.
_UNENCODABLE = (RecursionError, ValueError, TypeError, OverflowError)


def read_operation(data: bytes, budget: Budget) -> Operation:
    """Return the operation in the message *data*.

    NaN and Infinity are no JSON, but Python programs write them: in messages of topics they become null, as
    in rosbridge_suite; in the arguments of a service they are an error.

    Raises:
        ProtocolError: The message is malformed or not supported, or exceeds a limit of *budget*.
    """
    check_size(data, budget)
    try:
        operation = _decode(data)
        data.decode()  # raises unless the message is valid UTF-8, since parts of it are passed on as text
    except msgspec.ValidationError as error:
        raise BadMessage(str(error)[:200], hint=_PAGE) from error
    except _UNDECODABLE as error:
        operation = _read_not_finite(data, budget, error)
    if operation.op in _UNSUPPORTED:
        raise UnsupportedProtocol(
            f"{_UNSUPPORTED[operation.op]} not supported here", hint="see docs/rosbridge.md, what is refused"
        )
    if operation.op not in OPS:
        raise BadMessage(f"op {operation.op[:40]!r} is unknown", hint=_PAGE)
    if operation.op == "publish":
        if not bytes(operation.msg):
            raise BadMessage("a publish has no msg", hint="send op, topic and msg")
        check_json(bytes(operation.msg), budget)
    elif operation.op == "call_service":
        check_json(bytes(operation.args), budget)
    return operation


def _read_not_finite(data: bytes, budget: Budget, error: Exception) -> Operation:
    """Return the operation in *data* if only NaN and Infinity make it invalid JSON.

    Raises:
        BadMessage: *data* is malformed in another way, for which *error* was raised, or is a call of a
            service.
    """
    malformed = BadMessage(
        f"not a message of rosbridge: {str(error)[:150]}", hint="send JSON as text, not CBOR"
    )
    check_json(data, budget)
    not_finite: list[str] = []
    try:
        value = json.loads(data, parse_constant=not_finite.append)  # append returns None, which becomes null
        operation = _decode(json.dumps(value, allow_nan=False))
    except _UNDECODABLE:
        raise malformed from error
    if not not_finite:
        raise malformed from error
    if operation.op == "call_service":
        raise BadMessage(
            f"the arguments of a service hold {not_finite[0]}", hint="send finite numbers, or null"
        )
    return operation


def read_head(data: bytes) -> Head:
    """Return operation, id and service of the rejected message *data*, as far as they are valid.

    All are None for malformed JSON.
    """
    try:
        head = msgspec.convert(json.loads(data), Head)
    except _UNDECODABLE:
        return Head()
    is_id = isinstance(head.id, int) or (_is_text(head.id) and len(head.id) <= 256)
    service = head.service if _is_text(head.service) else ""
    return Head(head.op, head.id if is_id else None, service[:256])


def _is_text(value: Any) -> bool:
    """Return whether *value* is a text that can be encoded as UTF-8; one with a lone surrogate cannot."""
    try:
        return isinstance(value, str) and value.encode() is not None
    except UnicodeEncodeError:
        return False


def publication(topic: str, message: bytes) -> bytes:
    """Return the encoded ``publish`` with the JSON *message* for a subscriber of *topic*."""
    return _encode(_Publication("publish", topic, msgspec.Raw(message)))


def response(call: Operation | Head, values: Any, *, is_result: bool = True) -> bytes:
    """Return the encoded ``service_response`` with *values* for *call*; *is_result* is False for an error.

    Raises:
        BadMessage: The values cannot be encoded as JSON.
    """
    try:
        return _encode(_Response("service_response", call.service, values, is_result, call.id))
    except _UNENCODABLE as error:
        raise BadMessage(
            f"a reply cannot be encoded: {str(error)[:150]}", hint="ask with a client of the platform"
        ) from error


def refusal(of: Operation | Head, error: RsePfError) -> bytes:
    """Return the encoded answer about *error*: a ``service_response`` for a call, else a ``status``."""
    named = {"code": error.code, "message": error.message, "hint": error.hint}
    if of.op == "call_service":
        return response(of, {**named, "retry_after_ms": error.retry_after_ms}, is_result=False)
    hint = f"; {error.hint}" if error.hint else ""
    text = f"{error.code}: {error.message}{hint}"
    return _encode(_Status("status", "error", text, of.id, error.code, error.hint, error.retry_after_ms))
