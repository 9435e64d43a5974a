"""The inside of one job: a process of its own that steps back behind everything else, works once and ends.

It talks with its worker over one socket: an order in; progress, then one answer out.  Promises to run at
the lowest priority there is, to stay within its memory, and not to outlive its worker.  It reads its inputs
and stores its reply itself: a worker has robots to answer.
"""

from __future__ import annotations

import contextlib
import resource
import select
import socket
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import msgspec

from rse_pf.backend.job_store import is_shared, open_job_store
from rse_pf.backend.object_refs import named_in, resolve
from rse_pf.backend.quota import check_room, store_within
from rse_pf.backend.sandbox.ipc import encode_message, receive
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage, Cancelled, Crashed, LimitExceeded, RsePfError, StoreError
from rse_pf.linux import die_with_parent, run_when_idle
from rse_pf.object_store import ObjectStore
from rse_pf.service import dispatch, failure_of
from rse_pf.services.loading import load_services
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.arrays import binary_encode_hook

__all__ = ["kept", "main"]

_REPORT_PAUSE_S = 0.5
_STORE_TRIES = 3


def main(arguments: list[str]) -> None:
    """Do the one job that the worker orders over the socket with this number."""
    with socket.socket(fileno=int(arguments[0])) as worker:
        order = receive(worker)
        if order is None or not die_with_parent(order["worker"]):
            return
        _step_back()
        resource.setrlimit(resource.RLIMIT_DATA, (order["memory_bytes"],) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(OSError):  # a worker that does not wait any longer is no defect
            worker.sendall(encode_message(kept(_work(order, _Reporter(worker, time.monotonic)), order)))


class _Reporter:
    """Tells the worker how far the job is, and hears from it that nobody wants it any longer."""

    def __init__(self, worker: socket.socket, clock: Callable[[], float]) -> None:
        self._worker = worker
        self._clock = clock
        self._told_s = float("-inf")

    def __call__(self, done: float, what: str) -> None:
        if select.select([self._worker], [], [], 0)[0]:
            raise Cancelled("the robot took the command back")
        now = self._clock()
        if now - self._told_s >= _REPORT_PAUSE_S:
            self._told_s = now
            self._worker.sendall(encode_message(["progress", float(done), str(what)[:200]]))


def _work(order: dict[str, Any], report: Callable[[float, str], None]) -> list[Any]:
    command = Command(id=0, service=order["service"], payload=order["payload"])
    out_of_memory = False

    def on_defect(_: Command, error: Exception) -> None:
        nonlocal out_of_memory
        out_of_memory = isinstance(error, MemoryError)
        traceback.print_exception(error)

    try:
        settings = PlatformSettings.from_dict(order["settings"])
        registry = load_services(order["services"], settings)
        _look_for_room(order, settings)
        payload = _resolved(command.payload, registry.get(command.service).request_type, order, settings)
        command = msgspec.structs.replace(command, payload=payload)
        answer = dispatch(registry, command, time.monotonic, on_defect=on_defect, report=report)
    except RsePfError as error:
        answer = failure_of(error)
    except MemoryError:
        out_of_memory = True
    if out_of_memory:
        megabytes = order["memory_bytes"] / 1e6
        answer = failure_of(
            Crashed(f"the job needs more than {megabytes:.0f} MB of memory", hint="send less at once")
        )
    return _told(answer)


def _resolved(
    payload: Any, request_type: type[Any], order: dict[str, Any], settings: PlatformSettings
) -> Any:
    """Return the payload with the robot's own objects in the place of their names."""
    if not named_in(request_type, payload):
        return payload
    store = open_job_store(settings)
    return resolve(request_type, payload, order["tenant"], order["robot"], store, settings=settings.serving)


def _look_for_room(order: dict[str, Any], settings: PlatformSettings) -> None:
    """Raise QuotaExceeded before the work, not after it, where its result has no place."""
    if is_shared(settings):
        store = open_job_store(settings)
        with contextlib.suppress(StoreError):  # whether it can keep the result shows when there is one
            check_room(store, order["tenant"], order["robot"], 1, order["quota_bytes"])


def kept(told: list[Any], order: dict[str, Any]) -> list[Any]:
    """Store the reply here, where it disturbs nobody, and tell its name; small ones go along."""
    settings = PlatformSettings.from_dict(order["settings"])
    if told[0] != "done" or not is_shared(settings):
        return told
    _, compute_ms, reply = told
    try:
        if len(reply) > settings.data.max_object_bytes:
            raise LimitExceeded(f"a reply of {len(reply)} bytes is too large", hint="ask for less")
        digest = _stored(reply, order, open_job_store(settings))
    except RsePfError as error:
        return _told(failure_of(error))
    return ["stored", compute_ms, digest, len(reply), reply if len(reply) <= order["inline_bytes"] else None]


def _stored(reply: bytes, order: dict[str, Any], store: ObjectStore) -> str:
    for _ in range(_STORE_TRIES - 1):
        with contextlib.suppress(StoreError):
            return store_within(store, order["tenant"], order["robot"], reply, order["quota_bytes"])
    return store_within(store, order["tenant"], order["robot"], reply, order["quota_bytes"])


def _told(answer: Result | Failure) -> list[Any]:
    if isinstance(answer, Failure):
        return ["failed", answer.code, answer.message, answer.hint]
    try:
        reply = msgspec.msgpack.encode(answer.reply, enc_hook=binary_encode_hook)
    except (BadMessage, TypeError, ValueError, OverflowError) as error:
        return ["failed", "internal", f"the reply does not travel: {str(error)[:150]}", ""]
    return ["done", answer.compute_ms, reply]


def _step_back() -> None:
    """Run only when nothing else wants to; be the first to go when memory is short."""
    run_when_idle(0)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
        file.write("1000")


if __name__ == "__main__":
    main(sys.argv[1:])
