"""The engine of parts on Dask: a scheduler and workers in processes, here or on other machines.

Dask is told names only.  A worker that ends is replaced and its part is given to another; a scheduler on this
machine that ends is started again, and the parts that are not stored yet are handed to it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.batch.node import NodeOrder, compute, security_of
from rse_pf.batch.parts import Part, encode_part, is_done
from rse_pf.child.start import Child, ChildPlan, start_child
from rse_pf.config import PlatformSettings
from rse_pf.errors import Crashed, Disconnected, MissingExtra, error_from_code
from rse_pf.ipc import receive
from rse_pf.object_store import ObjectStore
from rse_pf.one_thread import ONE_THREAD
from rse_pf.terminal import counted

__all__ = [
    "ClusterKey",
    "DaskEngine",
    "LocalCluster",
    "new_cluster_key",
    "start_worker",
]

PART_TRIES = 3
"""A part whose workers ended this often is not tried again."""
_SCHEDULER_RESTARTS = 3
"""How often a lost scheduler is started again."""
_START_TIMEOUT_S = 60.0
_POLL_S = 0.2
_DASK = {
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "10s",
    "DASK_DISTRIBUTED__ADMIN__LOG_LENGTH": "100",
    "DASK_LOGGING__DISTRIBUTED": "critical",
}
_MAX_WORKER_STARTS = 20
"""Of all workers of one run, beyond their number: a machine on which they cannot live ends the run."""


@dataclass(frozen=True, slots=True)
class ClusterKey:
    """Certificate and key (PEM) of one cluster; anybody who has them may run code in it."""

    certificate: str
    key: str


def new_cluster_key() -> ClusterKey:
    """Return a new certificate and key for one run; raises MissingExtra."""
    try:
        from distributed.security import Security
    except ImportError as error:
        raise MissingExtra("distributed", "batch") from error
    made = Security.temporary()
    return ClusterKey(certificate=made.tls_ca_file, key=made.tls_client_key)


class LocalCluster:
    """A scheduler and workers as child processes of this one; they end with it."""

    def __init__(
        self,
        key: ClusterKey,
        workers: int,
        *,
        part_tries: int = PART_TRIES,
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        """Start nothing yet.

        Args:
            key: Of the cluster.
            workers: Number of worker processes on this machine; others may join.
            part_tries: A part whose workers ended this often is not tried again.
            host: Address on which the scheduler listens.
            port: Its port; 0 takes a free one.
        """
        self.address = ""
        self.part_tries = part_tries
        self._key = key
        self._count = workers
        self._environment = {
            **_DASK, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(part_tries - 1)
        }  # fmt: skip
        self._host, self._port = host, port
        self._scheduler: Child | None = None
        self._workers: list[Child] = []
        self._starts = 0

    @property
    def scheduler_pid(self) -> int:
        """Return the pid of the scheduler; 0 before the start."""
        return self._scheduler.pid if self._scheduler is not None else 0

    @property
    def worker_pids(self) -> list[int]:
        """Return the pids of the workers of this machine."""
        return [each.pid for each in self._workers]

    @property
    def is_lost(self) -> bool:
        """Whether the scheduler has ended."""
        return self._scheduler is None or self._scheduler.exit_code() is not None

    def start(self) -> None:
        """Start scheduler and workers; raises Crashed if the scheduler does not come up."""
        self.stop()
        self._scheduler = self._spawn(
            "scheduler", NodeOrder(**self._order(), host=self._host, port=self._port)
        )
        self.address = _address(self._scheduler, _START_TIMEOUT_S)
        self._workers = [self._start_worker() for _ in range(self._count)]

    def replace_dead_workers(self) -> int:
        """Start a worker for each one that ended; return how many.

        Raises:
            Crashed: Too many have ended.
        """
        dead = [row for row, each in enumerate(self._workers) if each.exit_code() is not None]
        for row in dead:
            self._starts += 1
            if self._starts > _MAX_WORKER_STARTS:
                raise Crashed(
                    f"{_MAX_WORKER_STARTS} workers ended",
                    hint="look at the memory of this machine; use fewer",
                )
            self._workers[row].kill()
            self._workers[row] = self._start_worker()
        return len(dead)

    def stop(self) -> None:
        """Kill all processes and wait for them."""
        for each in [*self._workers, *([self._scheduler] if self._scheduler is not None else [])]:
            each.kill()
        self._workers, self._scheduler = [], None

    def _order(self) -> dict[str, Any]:
        return {"certificate": self._key.certificate, "key": self._key.key}

    def _start_worker(self) -> Child:
        return self._spawn("worker", NodeOrder(**self._order(), address=self.address))

    def _spawn(self, role: str, order: NodeOrder) -> Child:
        return _spawn(role, order, self._environment)


def start_worker(certificate: str, key: str, address: str, *, ports: str) -> Child:
    """Start a worker of the scheduler at *address*, on one of *ports*; it ends with this process."""
    return _spawn("worker", NodeOrder(certificate=certificate, key=key, address=address, ports=ports), _DASK)


def _spawn(role: str, order: NodeOrder, environment: Mapping[str, str]) -> Child:
    plan = ChildPlan(target=f"rse_pf.batch.node:run_{role}", name=f"batch-{role}")
    child = start_child(
        plan, environment={**os.environ, **ONE_THREAD, **environment}, output=subprocess.DEVNULL
    )
    child.say(msgspec.to_builtins(order))
    return child


class DaskEngine:
    """Computes parts by the workers of a cluster."""

    def __init__(
        self,
        store: ObjectStore,
        settings: PlatformSettings,
        cluster: LocalCluster,
        key: ClusterKey,
        *,
        on_event: Callable[[str], None] = lambda text: None,
        on_start: Callable[[str], None] | None = None,
    ) -> None:
        """Connect to nothing yet.

        Args:
            store: The same as that of ``settings.data.store``, which the workers open.
            settings: Sent to the workers.
            cluster: Started, but not stopped, by this engine.
            key: Of the cluster.
            on_event: Called with one line when a worker or a scheduler was replaced.
            on_start: Called with the scheduler's address when it was started.
        """
        self._store = store
        self._settings = msgspec.json.encode(settings.to_dict())
        self._cluster = cluster
        self._key = key
        self._on_event = on_event
        self._on_start = on_start
        self._client: Any = None
        self._restarts = 0

    def start(self) -> None:
        """Start the cluster; raises Crashed if it does not come up."""
        self._cluster.start()
        if self._on_start is not None:
            self._on_start(self._cluster.address)

    def run(self, parts: Sequence[Part], on_done: Callable[[int], None]) -> None:
        """Compute *parts*.

        Raises:
            Disconnected: The scheduler ended too often.
            Crashed: A part ended its workers, or workers could not live.
            RsePfError: A part failed.
        """
        done: set[str] = set()
        while len(done) < len({part.name for part in parts}):
            waiting = [part for part in parts if part.name not in done]
            try:
                self._connect()
                for name in self._computed(waiting):
                    done.add(name)
                    on_done(len(done))
            except _SchedulerLost:
                self._restart()
                done |= {part.name for part in waiting if is_done(self._store, part)}
                on_done(len(done))

    def close(self) -> None:
        """Disconnect from the scheduler."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):
                client.close(timeout=1)

    def _connect(self) -> None:
        if self._client is not None:
            return
        from distributed import Client

        _silence()
        security = security_of(self._key.certificate, self._key.key)
        try:
            self._client = Client(
                self._cluster.address, security=security, timeout=_START_TIMEOUT_S, set_as_default=False
            )
        except (OSError, TimeoutError) as error:
            raise _SchedulerLost from error

    def _computed(self, parts: Sequence[Part]) -> Iterator[str]:
        """Hand out *parts* and yield the name of each when it is done."""
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        futures: dict[str, Any] = {}
        try:
            for part in parts:
                futures[part.name] = self._client.submit(
                    compute, self._settings, encode_part(part), key=part.name, pure=True, retries=0
                )  # fmt: skip
            for future in futures.values():
                future.add_done_callback(ended.put)
            while futures:
                self._look_after()
                try:
                    future = ended.get(timeout=_POLL_S)
                except queue.Empty:
                    continue
                failure = self._answer_of(future)
                if failure:
                    code, message, hint = failure
                    raise error_from_code(code, message, hint=hint)
                del futures[future.key]
                yield future.key
        except (OSError, TimeoutError, CancelledError) as error:
            raise _SchedulerLost from error

    def _answer_of(self, future: Any) -> list[str]:
        """Return what `compute` returned; raises Crashed if the part ended its workers."""
        from distributed.scheduler import KilledWorker

        try:
            answer: list[str] = future.result(timeout=_START_TIMEOUT_S)
        except KilledWorker as error:
            raise Crashed(
                f"a part ended {self._cluster.part_tries} workers",
                hint="look at the memory of the workers; use fewer, or merge fewer maps",
            ) from error
        return answer

    def _look_after(self) -> None:
        if self._cluster.is_lost:
            raise _SchedulerLost
        replaced = self._cluster.replace_dead_workers()
        if replaced:
            self._on_event(f"{counted(replaced, 'worker')} replaced, which had ended")

    def _restart(self) -> None:
        self.close()
        self._restarts += 1
        if self._restarts > _SCHEDULER_RESTARTS:
            raise Disconnected(
                f"the scheduler ended {self._restarts} times", hint="run the same command again: it continues"
            )
        self.start()
        self._on_event("the scheduler ended and was started again")


def _silence() -> None:
    """Keep what Dask logs about lost connections from the terminal: the engine says what happened."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))]
    for name in [*names, "distributed", "tornado", "asyncio"]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


class _SchedulerLost(Exception):
    """The scheduler does not answer any more."""


def _address(scheduler: Child, timeout_s: float) -> str:
    """Return the address that *scheduler* tells; raises Crashed."""
    try:
        address: str | None = receive(scheduler.connection, time.monotonic() + timeout_s)
    except TimeoutError:
        address = None
    if address is None:
        raise Crashed(
            "the scheduler of the batch did not start", hint="is its port free, and is its host ours?"
        )
    return address
