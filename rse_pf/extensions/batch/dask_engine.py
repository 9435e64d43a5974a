"""The engine that computes parts on Dask: with child processes on this machine, or with a running scheduler.

Dask transports the settings, and the names and arguments of parts; inputs and results are in the object
store.  If a worker process of this machine exits, it is replaced and Dask gives its part to another worker.
If the scheduler exits or cannot be reached, it is started or connected again, and gets the parts that are not
stored yet.
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
"""A part fails after this many workers have exited while they computed it.

With ``--scheduler`` the limit of that
scheduler applies."""
# Largest number of times that the connection to a scheduler is restored, or the scheduler restarted, in a
# run.
_SCHEDULER_RESTARTS = 3
# Time limit for the start of a scheduler, for a connection to it, and for the result of a finished part, in
# seconds.
_START_TIMEOUT_S = 60.0
# Time limit for a running scheduler to answer, and then to have a worker, in seconds.
_REMOTE_TIMEOUT_S = 10.0
# Pattern of the address of a Dask scheduler.
_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?[^\s:/]+(?::[^\s:/]+)*:\d{1,5}")
# Time between two checks of scheduler and workers while parts are computed, in seconds.
_CHECK_INTERVAL_S = 0.2
# Dask's settings in the environment of scheduler and workers.
_DASK_ENVIRONMENT = {
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "10s",
    "DASK_DISTRIBUTED__ADMIN__LOG_LENGTH": "100",
    "DASK_LOGGING__DISTRIBUTED": "critical",
}
# Largest number of workers that are replaced in a run.  If more exit, the machine cannot run the workers, and
# the run fails.
_MAX_WORKER_STARTS = 20


@dataclass(frozen=True, slots=True)
class ClusterKey:
    """Certificate and key (PEM) of one cluster; a process that has both may run code in the cluster."""

    certificate: str
    key: str


def new_cluster_key() -> ClusterKey:
    """Return a new certificate and key for one run; raises MissingExtra if Dask is not installed."""
    try:
        from distributed.security import Security
    except ImportError as error:
        raise MissingExtra("distributed", "batch") from error
    made = Security.temporary()
    return ClusterKey(certificate=made.tls_ca_file, key=made.tls_client_key)


class Cluster(Protocol):
    """A Dask scheduler with workers; ``address`` is that of the scheduler."""

    address: str

    @property
    def is_lost(self) -> bool:
        """Whether the scheduler has exited, as far as this process knows."""

    def start(self) -> None:
        """Start scheduler and workers, or check that they run; raises RsePfError if they do not."""

    def replace_dead_workers(self) -> int:
        """Start a new worker for each worker that has exited; return the number of new workers."""

    def stop(self) -> None:
        """Stop the processes that `start` started."""

    def security(self) -> Any:
        """Return Dask's Security for a client; None for that of Dask's configuration."""


class RemoteCluster:
    """A running scheduler with its workers, which this process neither starts nor stops.

    TLS is that of Dask's configuration.
    """

    is_lost = False

    def __init__(self, address: str) -> None:
        """Describe the cluster; raises UsageError if *address* is not the address of a scheduler."""
        if _ADDRESS.fullmatch(address) is None:
            raise UsageError(
                f"{address[:80]!r} is no address of a Dask scheduler",
                hint="write HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT, as dask scheduler prints it",
            )
        self.address = address if "://" in address else f"tcp://{address}"

    def start(self) -> None:
        """Check that the scheduler answers, has a worker, and runs this version of rse-pf.

        Raises:
            Disconnected: The scheduler does not answer within 10 s, or has no worker after another 10 s.
            ConfigurationError: A certificate is missing, or a process has another version of rse-pf.
        """
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
        """Return 0: the workers of a remote cluster are not replaced."""
        return 0

    def stop(self) -> None:
        """Do nothing: this process started no process of the cluster."""

    def security(self) -> None:
        """Return None: TLS is that of Dask's configuration."""


class LocalCluster:
    """A scheduler and workers that are child processes of this process, and exit with it."""

    def __init__(self, workers: int, *, part_tries: int = PART_TRIES) -> None:
        """Describe the cluster; no process is started.

        Args:
            workers: Number of worker processes.
            part_tries: A part fails after this many workers have exited while they computed it.
        """
        self.address = ""
        self._key = new_cluster_key()
        self._count = workers
        self._environment = {
            **_DASK_ENVIRONMENT, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(part_tries - 1)
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
        """Return the pids of the workers, including those that have exited and are not yet replaced."""
        return [each.pid for each in self._workers]

    @property
    def is_lost(self) -> bool:
        """Whether the scheduler has exited or was not started."""
        return self._scheduler is None or self._scheduler.exit_code() is not None

    def start(self) -> None:
        """Stop running processes, then start scheduler and workers.

        Raises:
            Crashed: The scheduler did not report its address within 60 s.
        """
        self.stop()
        self._scheduler = self._spawn("scheduler", "")
        self.address = _address(self._scheduler, _START_TIMEOUT_S)
        self._workers = [self._start_worker() for _ in range(self._count)]

    def replace_dead_workers(self) -> int:
        """Start a new worker for each worker that has exited; return the number of new workers.

        Raises:
            Crashed: More than 20 workers have exited in this run.
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
        """Kill scheduler and workers, and wait until they have exited."""
        for each in [*self._workers, *([self._scheduler] if self._scheduler is not None else [])]:
            each.kill()
        self._workers, self._scheduler = [], None

    def security(self) -> Any:
        """Return Dask's Security with the certificate and key of this cluster."""
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
    """Computes the parts of a batch job by the workers of a cluster.

    If the scheduler is lost, the cluster is started again, at most three times, and the parts whose results
    are not in the store are computed again.  A `RemoteCluster` is not started, but must answer again.
    """

    def __init__(
        self,
        store: ObjectStore,
        settings: PlatformSettings,
        cluster: Cluster,
        *,
        on_event: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Describe the engine; nothing is started or connected.

        Args:
            store: The object store of ``settings.data.store``, which the workers open as well.
            settings: The settings that are sent to the workers.
            cluster: The cluster; this engine starts it, but does not stop it.
            on_event: Called with one line of text when a worker or the scheduler was replaced.
        """
        self._store = store
        self._settings = msgspec.json.encode(settings.to_dict())
        self._cluster = cluster
        self._on_event = on_event
        self._client: Any = None
        self._restarts = 0

    def start(self) -> None:
        """Start the cluster; raises RsePfError if it does not start."""
        self._cluster.start()

    def run(self, parts: Sequence[Part], on_done: Callable[[int], None]) -> None:
        """Compute *parts*, whose results are in the store afterwards.

        Call *on_done* with the number computed so far.

        Raises:
            Disconnected: The scheduler was lost more than three times.
            Crashed: Too many workers exited, during one part or in the whole run.
            RsePfError: The computation of a part failed.
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
        """Disconnect from the scheduler; errors are ignored."""
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
        """Submit *parts* to the scheduler, and yield the name of each part once it is computed.

        Raises:
            _SchedulerLost: The scheduler exited or cannot be reached.
            RsePfError: The computation of a part failed, or its workers exited.
        """
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
                self._check_cluster()
                try:
                    future = ended.get(timeout=_CHECK_INTERVAL_S)
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
        """Return the result of `compute` for a part; raises Crashed if too many workers exited during it."""
        from distributed.scheduler import KilledWorker

        try:
            answer: list[str] = future.result(timeout=_START_TIMEOUT_S)
        except KilledWorker as error:
            raise Crashed(
                f"a part ended {error.allowed_failures + 1} workers",
                hint="look at the memory of the workers; use fewer, or merge fewer maps",
            ) from error
        return answer

    def _check_cluster(self) -> None:
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
    """Raise ConfigurationError if scheduler or a worker has another version of rse-pf than this process.

    *about* is the result of Dask's ``Client.get_versions``.
    """
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
    """Disable the loggers of Dask, since the engine itself reports lost connections."""
    names = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))]
    for name in [*names, "distributed", "tornado", "asyncio"]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


class _SchedulerLost(Exception):
    """The scheduler has exited or does not answer."""


def _address(scheduler: Child, timeout_s: float) -> str:
    """Return the address that the process *scheduler* sends; raises Crashed if it exits or takes too long."""
    try:
        address: str | None = receive(scheduler.connection, time.monotonic() + timeout_s)
    except TimeoutError:
        address = None
    if address is None:
        raise Crashed(
            "the scheduler of the batch did not start", hint="is its port free, and is its host ours?"
        )
    return address
