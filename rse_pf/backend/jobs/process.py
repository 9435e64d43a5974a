"""The process of one job: the worker starts it with `JobProcess`, it runs one command and ends.

Over one socket it receives an order, sends progress and then one answer.  It runs at the lowest priority,
within its memory limit, and does not outlive its worker.  It reads its inputs and stores its reply itself, so
that the worker can serve robots meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import msgspec

from rse_pf.aws.storage import open_data_store
from rse_pf.backend.jobs.runner import JobRequest
from rse_pf.backend.object_refs import named_in, resolve
from rse_pf.backend.robot_store import check_quota, is_shared, store_within_quota
from rse_pf.backend.sandbox.ipc import encode_message, receive
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage, Cancelled, Crashed, LimitExceeded, RsePfError, StoreError
from rse_pf.linux import die_with_parent, run_when_idle
from rse_pf.object_store import ObjectStore
from rse_pf.service import dispatch, failure_of
from rse_pf.services.loading import load_services
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.arrays import binary_encode_hook

__all__ = ["JobProcess", "main", "spawner", "store_reply"]

_REPORT_INTERVAL_S = 0.5
_STORE_TRIES = 3
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class JobProcess:
    """A started process and the socket to it.

    It uses one thread for linear algebra, so that the same inputs give the same result.
    """

    def __init__(self, order: dict[str, Any]) -> None:
        self.connection, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.backend.jobs.process", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, env={**os.environ, **_ONE_THREAD},
            )  # fmt: skip
        run_when_idle(self._process.pid)
        try:
            self.connection.sendall(encode_message(order))
        except OSError:
            return  # it has ended, which the next read shows

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def kill(self) -> None:
        """Kill and reap it."""
        self._process.kill()
        self._process.wait()
        self.connection.close()

    def wait(self) -> int:
        """Wait for its end and return the exit code; negative for a signal."""
        return self._process.wait()


def spawner(services: str, settings: PlatformSettings) -> Callable[[JobRequest], JobProcess]:
    """Return a function that starts the process of a job; *services* is ``module:function``."""
    plain = settings.to_dict()

    def start(request: JobRequest) -> JobProcess:
        return JobProcess(
            {
                "worker": os.getpid(), "services": services, "settings": plain,
                "memory_bytes": settings.serving.max_job_memory_bytes, "service": request.service,
                "payload": request.payload, "tenant": request.tenant, "robot": request.robot,
                "quota_bytes": request.quota_bytes, "inline_bytes": settings.session.max_message_bytes // 2,
            }
        )  # fmt: skip

    return start


def main(arguments: list[str]) -> None:
    """Run the one job that the worker orders over the socket with this number."""
    with socket.socket(fileno=int(arguments[0])) as worker:
        order = receive(worker)
        if order is None or not die_with_parent(order["worker"]):
            return
        _lower_priority()
        resource.setrlimit(resource.RLIMIT_DATA, (order["memory_bytes"],) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(OSError):  # the worker may have gone
            worker.sendall(
                encode_message(store_reply(_work(order, _Reporter(worker, time.monotonic)), order))
            )


class _Reporter:
    """Sends progress to the worker; raises Cancelled when the worker has sent anything."""

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
        _check_quota(order, settings)
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
    return _encode_answer(answer)


def _resolved(
    payload: Any, request_type: type[Any], order: dict[str, Any], settings: PlatformSettings
) -> Any:
    """Return the payload with the robot's objects in place of their names."""
    if not named_in(request_type, payload):
        return payload
    store = open_data_store(settings)
    return resolve(request_type, payload, order["tenant"], order["robot"], store, settings=settings.serving)


def _check_quota(order: dict[str, Any], settings: PlatformSettings) -> None:
    """Raise QuotaExceeded before the work if its result cannot be stored."""
    if is_shared(settings):
        store = open_data_store(settings)
        with contextlib.suppress(StoreError):  # the store is tried again when there is a result
            check_quota(store, order["tenant"], order["robot"], 1, order["quota_bytes"])


def store_reply(answer: list[Any], order: dict[str, Any]) -> list[Any]:
    """Store the reply from this process and answer with its name, and with the reply if it is small."""
    settings = PlatformSettings.from_dict(order["settings"])
    if answer[0] != "done" or not is_shared(settings):
        return answer
    _, compute_ms, reply = answer
    try:
        if len(reply) > settings.data.max_object_bytes:
            raise LimitExceeded(f"a reply of {len(reply)} bytes is too large", hint="ask for less")
        digest = _stored(reply, order, open_data_store(settings))
    except RsePfError as error:
        return _encode_answer(failure_of(error))
    return ["stored", compute_ms, digest, len(reply), reply if len(reply) <= order["inline_bytes"] else None]


def _stored(reply: bytes, order: dict[str, Any], store: ObjectStore) -> str:
    for _ in range(_STORE_TRIES - 1):
        with contextlib.suppress(StoreError):
            return store_within_quota(store, order["tenant"], order["robot"], reply, order["quota_bytes"])
    return store_within_quota(store, order["tenant"], order["robot"], reply, order["quota_bytes"])


def _encode_answer(answer: Result | Failure) -> list[Any]:
    if isinstance(answer, Failure):
        return ["failed", answer.code, answer.message, answer.hint]
    try:
        reply = msgspec.msgpack.encode(answer.reply, enc_hook=binary_encode_hook)
    except (BadMessage, TypeError, ValueError, OverflowError) as error:
        return ["failed", "internal", f"the reply cannot be encoded: {str(error)[:150]}", ""]
    return ["done", answer.compute_ms, reply]


def _lower_priority() -> None:
    """Run only when the processors are idle; be killed first when memory is short."""
    run_when_idle(0)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
        file.write("1000")


if __name__ == "__main__":
    main(sys.argv[1:])
