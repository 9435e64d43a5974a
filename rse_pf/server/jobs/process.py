"""The process of one job: a worker starts it (`spawner`), and it runs one job and exits (`run`).

1. It receives an order from the worker on its socket: the job's request and the settings.
2. It reads the stored objects to which the request refers, and calls the service.
3. It sends progress to the worker meanwhile.  Any message from the worker cancels the job.
4. It stores the reply, and sends one answer: ``stored`` (or ``done`` without access to the store), or
   ``failed``.

It runs at a lower priority than the workers, within a memory limit, and is killed when its worker exits.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import (
    BadMessage,
    Cancelled,
    Crashed,
    LimitExceeded,
    RsePfError,
    StoreError,
    message_of,
)
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import encode_message, receive
from rse_pf.processes.start import Child, ChildPlan, start_child
from rse_pf.server.object_refs import named_in, resolve
from rse_pf.server.robot_store import is_shared, store_within_quota
from rse_pf.service import dispatch, failure_of
from rse_pf.services.loading import load_services
from rse_pf.storage.quotas import Accounts
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.arrays import binary_encode_hook

__all__ = ["JobRequest", "inline_bytes", "retry_store", "run", "spawner", "store_reply"]

# Niceness of a job's process.  On a busy core, Linux then gives a tenth of the time to the job, so that it
# makes progress, and nine tenths to the commands of robots.
_NICE = 10
_REPORT_INTERVAL_S = 0.5  # shortest time in seconds between two progress messages to the worker
_STORE_TRIES = 3  # tries of an operation on the object store, before the job fails
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRequest:
    """The request of a job.

    ``key`` is the digest of the request (`job_key`).  ``quota_bytes`` is the quota of all objects of the
    robot, the reply of the job included; None for ``data.quota_bytes``.
    """

    service: str
    payload: Any
    robot: RobotId
    key: str
    quota_bytes: float | None
    trace: str = ""
    """Trace id of the command that started the job."""


def spawner(services: str, settings: PlatformSettings) -> Callable[[JobRequest], Child]:
    """Return a function that starts the process of a job and sends it the order.

    *services* is the ``module:function`` that returns the registry of services.
    """
    plan = ChildPlan(
        target=f"{__name__}:run", name="rse-pf job", policy="batch", nice=_NICE, is_killed_first=True,
        memory_bytes=settings.serving.max_job_memory_bytes,
    )  # fmt: skip
    order = {"services": services, "settings": settings.to_dict()}

    def start(request: JobRequest) -> Child:
        child = start_child(plan)
        child.say({**order, "request": request})
        return child

    return start


def inline_bytes(settings: PlatformSettings) -> int:
    """Return the size in bytes above which a robot gets only the digest of a stored reply, and not the reply.

    It is half of ``session.max_message_bytes``, since the codec of the robot may need more bytes.
    """
    return settings.session.max_message_bytes // 2


def retry_store(act: Callable[[], T]) -> T:
    """Return the result of *act*; after a StoreError, call it again, at most `_STORE_TRIES` times in all."""
    for _ in range(_STORE_TRIES - 1):
        with contextlib.suppress(StoreError):
            return act()
    return act()


def run(worker: socket.socket) -> None:
    """Run the one job that is ordered on the socket *worker*; the entry point of the process."""
    with worker:
        order = receive(worker)
        if order is None:
            return
        settings, request = PlatformSettings.from_dict(order["settings"]), _request(order["request"])
        answer = _work(request, settings, order["services"], _Reporter(worker, time.monotonic))
        with contextlib.suppress(OSError):  # the worker may have exited
            worker.sendall(encode_message(store_reply(answer, request, settings)))


def _request(plain: dict[str, Any]) -> JobRequest:
    return JobRequest(**{**plain, "robot": RobotId(*plain["robot"])})


class _Reporter:
    """Sends the progress of the job to the worker; raises Cancelled if the worker has sent any message."""

    def __init__(self, worker: socket.socket, clock: Callable[[], float]) -> None:
        self._worker = worker
        self._clock = clock
        self._reported_s = float("-inf")

    def __call__(self, done: float, what: str) -> None:
        if select.select([self._worker], [], [], 0)[0]:
            raise Cancelled("the robot cancelled the command")
        now = self._clock()
        if now - self._reported_s >= _REPORT_INTERVAL_S:
            self._reported_s = now
            self._worker.sendall(encode_message(["progress", float(done), str(what)[:200]]))


def _work(
    request: JobRequest, settings: PlatformSettings, services: str, report: Callable[[float, str], None]
) -> list[Any]:
    """Call the service for the job, and return its encoded answer: ``done`` or ``failed``."""
    out_of_memory = False

    def on_defect(_: Command, error: Exception) -> None:
        nonlocal out_of_memory
        out_of_memory = isinstance(error, MemoryError)
        traceback.print_exception(error)

    try:
        registry = load_services(services, settings)
        _check_quota(request, settings)
        payload = _resolve_payload(request, registry.get(request.service).request_type, settings)
        command = Command(id=0, service=request.service, payload=payload)
        answer = dispatch(registry, command, time.monotonic, on_defect=on_defect, report=report)
    except RsePfError as error:
        answer = failure_of(error)
    except MemoryError:
        out_of_memory = True
    if out_of_memory:
        megabytes = settings.serving.max_job_memory_bytes / 1e6
        answer = failure_of(
            Crashed(f"the job needs more than {megabytes:.0f} MB of memory", hint="send less at once")
        )
    return _encode_answer(answer)


def _resolve_payload(request: JobRequest, kind: type[Any], settings: PlatformSettings) -> Any:
    """Return the payload with the bytes of the robot's objects in place of references to them."""
    if not named_in(kind, request.payload):
        return request.payload
    store = open_data_store(settings)
    return resolve(kind, request.payload, request.robot, store)


def _check_quota(request: JobRequest, settings: PlatformSettings) -> None:
    """Raise QuotaExceeded, before the work, if the robot cannot store one more byte."""
    if is_shared(settings):
        store = open_data_store(settings)
        with contextlib.suppress(StoreError):  # storing the reply is tried in any case
            Accounts(store, settings.data).check_room(request.robot, 1, request.quota_bytes)


def store_reply(answer: list[Any], request: JobRequest, settings: PlatformSettings) -> list[Any]:
    """Store the reply in *answer*, and return the answer with its digest, and with the reply if it is small.

    A failed answer, and any answer if this process has no access to the store, is returned unchanged.  If the
    reply cannot be stored, the answer is a failure.
    """
    if answer[0] != "done" or not is_shared(settings):
        return answer
    _, compute_ms, reply = answer
    try:
        if len(reply) > settings.data.max_object_bytes:
            limit = settings.data.max_object_bytes
            raise LimitExceeded(f"the reply has {len(reply)} bytes, above {limit}", hint="request less")
        store = open_data_store(settings)
        accounts = Accounts(store, settings.data)
        digest = retry_store(
            lambda: store_within_quota(store, accounts, request.robot, reply, request.quota_bytes)
        )
    except RsePfError as error:
        return _encode_answer(failure_of(error))
    inline = reply if len(reply) <= inline_bytes(settings) else None
    return ["stored", compute_ms, digest, len(reply), inline]


def _encode_answer(answer: Result | Failure) -> list[Any]:
    """Return the message about *answer* to the worker; a reply that cannot be encoded is a failure."""
    if isinstance(answer, Failure):
        return ["failed", answer.code, answer.message, answer.hint]
    try:
        reply = msgspec.msgpack.encode(answer.reply, enc_hook=binary_encode_hook)
    except (BadMessage, TypeError, ValueError, OverflowError) as error:
        return ["failed", "internal", f"the reply cannot be encoded: {message_of(error)[:150]}", ""]
    return ["done", answer.compute_ms, reply]
