"""The code that runs in a limited process: read stored objects, call the service, and encode its reply.

`encode_request` and `decode_reply` are called in the worker, on the other side of the process's socket.  The
process reads the objects that a command refers to itself, so that the worker never holds a map in memory.
"""

from __future__ import annotations

import contextlib
import functools
import json
import time
import traceback

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, InternalError, LimitExceeded, MissingExtra, RsePfError, message_of
from rse_pf.identity import RobotId
from rse_pf.processes.limited import Handler
from rse_pf.server.object_refs import resolve
from rse_pf.server.robot_store import is_shared
from rse_pf.service import Registry, dispatch, failure_of
from rse_pf.services.loading import load_services
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.arrays import binary_encode_hook, extension_hook

__all__ = ["TARGET", "configuration_of", "decode_reply", "encode_request", "make_handler"]

TARGET = f"{__name__}:make_handler"  # the function with which a limited process begins
_encode = msgspec.msgpack.Encoder(enc_hook=binary_encode_hook).encode
_decode = msgspec.msgpack.Decoder(ext_hook=extension_hook).decode


def configuration_of(services: str, settings: PlatformSettings) -> str:
    """Return the argument of `make_handler` as JSON.

    *services* is the ``module:function`` that returns the registry of services.
    """
    return json.dumps({"services": services, "settings": settings.to_dict()})


def encode_request(command: Command, robot: RobotId) -> bytes:
    """Return *command* and *robot* as MessagePack, for the handler of a limited process.

    Raises:
        BadRequest: The payload cannot be encoded.
    """
    try:
        return _encode([command.service, command.payload, command.trace, list(robot)])
    except (RsePfError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise BadRequest(f"the payload cannot be encoded: {message_of(error)[:150]}") from error


def decode_reply(data: bytes, command: Command, *, server: str) -> tuple[Result | Failure, str]:
    """Return the answer to *command* in the bytes *data* of a limited process, and a text for the log.

    The text is the traceback of an exception that the service should not raise, or "".
    """
    compute_ms, reply, failure, defect = _decode(data)
    if failure is None:
        return Result(id=command.id, reply=reply, server=server, compute_ms=compute_ms), ""
    code, message, hint, retry_after_ms = failure
    return Failure(
        id=command.id, code=code, message=message, hint=hint, retry_after_ms=retry_after_ms,
        server=server, trace=command.trace,
    ), defect  # fmt: skip


def make_handler(configuration: str) -> Handler:
    """Load and warm up the limited services, and return the function that answers one encoded command.

    Args:
        configuration: The result of `configuration_of`.
    """
    order = json.loads(configuration)
    settings = PlatformSettings.from_dict(order["settings"])
    registry = load_services(order["services"], settings)
    for service in registry:
        if service.limited and service.warm_up is not None:
            with contextlib.suppress(MissingExtra):  # each command of the service then gets this error
                service.warm_up()
    store = open_data_store(settings) if is_shared(settings) else None
    return functools.partial(_answer, registry, settings, store)


def _answer(registry: Registry, settings: PlatformSettings, store: ObjectStore | None, data: bytes) -> bytes:
    """Return the encoded answer to the encoded command *data*.

    Raises:
        MemoryError: The service exceeded the memory limit; the process then exits, and counts as crashed.
    """
    name, payload, trace, robot = _decode(data)
    try:
        if store is not None:
            kind = registry.get(name).request_type
            payload = resolve(kind, payload, RobotId(*robot), store)
    except RsePfError as error:
        return _encode_failure(failure_of(error))
    command = Command(id=0, service=name, payload=payload, trace=trace)
    defects: list[Exception] = []
    answer = dispatch(registry, command, time.monotonic, on_defect=lambda _, error: defects.append(error))
    if defects and isinstance(defects[0], MemoryError):
        raise defects[0]
    if isinstance(answer, Failure):
        return _encode_failure(answer, "".join(traceback.format_exception(*defects)) if defects else "")
    try:
        encoded = _encode([answer.compute_ms, answer.reply, None, ""])
    except (RsePfError, TypeError, ValueError, OverflowError, RecursionError) as error:
        defect = InternalError(f"the reply of {name!r} cannot be encoded")
        return _encode_failure(failure_of(defect), message_of(error))
    limit = settings.session.max_inflated_bytes
    if len(encoded) > limit:
        too_large = LimitExceeded(f"the reply has {len(encoded)} bytes, above {limit}", hint="ask for less")
        return _encode_failure(failure_of(too_large))
    return encoded


def _encode_failure(failure: Failure, defect: str = "") -> bytes:
    fields = [failure.code, failure.message, failure.hint, failure.retry_after_ms]
    return _encode([0.0, None, fields, defect])
