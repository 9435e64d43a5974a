"""The engine of parts on Dask: with processes of its own on this machine, or a scheduler that runs already.

Dask carries settings, and the names and arguments of parts.  A worker of its own that ends is replaced, and
its part is given to another; a scheduler that is lost is started or connected again, and the parts that are
not stored yet are handed to it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import re
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, Crashed, Disconnected, MissingExtra, UsageError, error_from_code
from rse_pf.extensions.batch.node import NodeOrder, compute, security_of
from rse_pf.extensions.batch.parts import Part, encode_part, is_done
from rse_pf.processes.ipc import receive
from rse_pf.processes.one_thread import ONE_THREAD
from rse_pf.processes.start import Child, ChildPlan, start_child
from rse_pf.storage.object_store import ObjectStore
from rse_pf.terminal import counted

__all__ = [
    "Cluster",
    "ClusterKey",
    "DaskEngine",
    "LocalCluster",
    "RemoteCluster",
    "new_cluster_key",
]

PART_TRIES = 3
"""A part whose workers ended this often is not tried again; with ``--scheduler`` Dask's own limit counts."""
_SCHEDULER_RESTARTS = 3
"""How often a lost scheduler is started again."""
_START_TIMEOUT_S = 60.0
_REMOTE_TIMEOUT_S = 10.0
"""A scheduler that runs already has to answer, and to have a worker, within this."""
_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?[^\s:/]+(?::[^\s:/]+)*:\d{1,5}")
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


class Cluster(Protocol):
    """A scheduler with workers."""

    address: str

    @property
    def is_lost(self) -> bool:
        """Whether the scheduler has ended, as far as this process knows."""

    def start(self) -> None:
        """Start it, or check that it runs; raises RsePfError."""

    def replace_dead_workers(self) -> int:
        """Start a worker for each one that ended; return how many."""

    def stop(self) -> None:
        """End what `start` started."""

    def security(self) -> Any:
        """Return Dask's TLS for a client; None for what Dask is configured with."""


class RemoteCluster:
    """A scheduler and workers that somebody else has started; TLS is that of Dask's configuration."""

    is_lost = False

    def __init__(self, address: str) -> None:
        """Connect to nothing yet; raises UsageError if *address* is none of a scheduler."""
        if _ADDRESS.fullmatch(address) is None:
            raise UsageError(
                f"{address[:80]!r} is no address of a Dask scheduler",
                hint="write HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT, as dask scheduler prints it",
            )
        self.address = address if "://" in address else f"tcp://{address}"

    def start(self) -> None:
        """Check that the scheduler answers and has a worker; raises Disconnected or ConfigurationError."""
        from distributed import Client
        from distributed.security import Security

        _silence()
        certificates = Security().get_connection_args("client").get("ssl_context")
        if self.address.startswith("tls:") and certificates is None:
            raise ConfigurationError(
                f"{self.address} needs certificates, and Dask is configured with none",
                hint="set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, and ...__CLIENT__CERT and ...__CLIENT__KEY",
            )
        try:
            client = Client(self.address, timeout=_REMOTE_TIMEOUT_S, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise Disconnected(
                f"no Dask scheduler answered at {self.address} within {_REMOTE_TIMEOUT_S:g} s",
                hint="start one (dask scheduler --host ADDRESS), or leave --scheduler out",
            ) from error
        try:
            client.wait_for_workers(1, timeout=_REMOTE_TIMEOUT_S)
            _check_versions(client.get_versions(check=False, packages=["rse_pf"]))
        except TimeoutError as error:
            raise Disconnected(
                f"the Dask scheduler at {self.address} has no worker after {_REMOTE_TIMEOUT_S:g} s",
                hint=f"start some with this version of rse-pf (dask worker {self.address} --nthreads 1)",
            ) from error
        finally:
            client.close(timeout=1)

    def replace_dead_workers(self) -> int:
        """Replace none: who started the workers looks after them."""
        return 0

    def stop(self) -> None:
        """Stop nothing."""

    def security(self) -> None:
        """Leave TLS to Dask's configuration."""


class LocalCluster:
    """A scheduler and workers as child processes of this one; they end with it."""

    def __init__(self, workers: int, *, part_tries: int = PART_TRIES) -> None:
        """Start nothing yet.

        Args:
            workers: Number of worker processes.
            part_tries: A part whose workers ended this often is not tried again.
        """
        self.address = ""
        self._key = new_cluster_key()
        self._count = workers
        self._environment = {
            **_DASK, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(part_tries - 1)
        }  # fmt: skip
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
        self._scheduler = self._spawn("scheduler", "")
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

    def security(self) -> Any:
        """Return the TLS of the cluster's key."""
        return security_of(self._key.certificate, self._key.key)

    def _start_worker(self) -> Child:
        return self._spawn("worker", self.address)

    def _spawn(self, role: str, address: str) -> Child:
        child = start_child(
            ChildPlan(target=f"rse_pf.extensions.batch.node:run_{role}", name=f"batch-{role}"),
            environment={**os.environ, **ONE_THREAD, **self._environment}, output=subprocess.DEVNULL,
        )  # fmt: skip
        order = NodeOrder(certificate=self._key.certificate, key=self._key.key, address=address)
        child.say(msgspec.to_builtins(order))
        return child


class DaskEngine:
    """Computes parts by the workers of a cluster."""

    def __init__(
        self,
        store: ObjectStore,
        settings: PlatformSettings,
        cluster: Cluster,
        *,
        on_event: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Connect to nothing yet.

        Args:
            store: The same as that of ``settings.data.store``, which the workers open.
            settings: Sent to the workers.
            cluster: Started, but not stopped, by this engine.
            on_event: Called with one line when a worker or a scheduler was replaced.
        """
        self._store = store
        self._settings = msgspec.json.encode(settings.to_dict())
        self._cluster = cluster
        self._on_event = on_event
        self._client: Any = None
        self._restarts = 0

    def start(self) -> None:
        """Start the cluster; raises RsePfError if it does not come up."""
        self._cluster.start()

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
        try:
            self._client = Client(
                self._cluster.address, security=self._cluster.security(), timeout=_START_TIMEOUT_S,
                set_as_default=False,
            )  # fmt: skip
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
                f"a part ended {error.allowed_failures + 1} workers",
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
        self._on_event("the connection to the scheduler was lost and is there again")


def _check_versions(about: Mapping[str, Any]) -> None:
    """Raise ConfigurationError if the scheduler or a worker cannot load what this process sends."""
    ours = about["client"]["packages"]["rse_pf"]
    for address, process in {"the Dask scheduler": about["scheduler"], **about["workers"]}.items():
        theirs = process["packages"].get("rse_pf")
        if theirs != ours:
            version = f"rse-pf {theirs}" if theirs else "no rse-pf"
            raise ConfigurationError(
                f"{address} has {version}, this command is rse-pf {ours}",
                hint=f"install rse-pf[batch]=={ours} there",
            )


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
