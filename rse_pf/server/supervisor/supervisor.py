"""One backend server: listener, worker processes, control port and drain; the body of `rse-pf serve`.

The supervisor accepts the sockets of robots, and passes each socket that has begun to send to the worker with
the fewest sockets.  It does not read what robots send.  A worker that crashed in native code is replaced
(`crash_recovery`).  If a worker exits in another way, the server exits, and the scale modifier replaces the
server.  A drain loses no command.
"""

from __future__ import annotations

import asyncio
import os
import random
import signal
import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.auth.control_token import carries_token
from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import TrustStore
from rse_pf.config import PlatformSettings
from rse_pf.config.elasticity import MOVE_WITHIN_MS, MOVES_PER_S
from rse_pf.config.placement import ServerPlacement
from rse_pf.http.control_port import (
    ControlReply,
    ControlRequest,
    json_reply,
    number_of,
    refused_reply,
)
from rse_pf.processes.event_loop import run_in_loop
from rse_pf.processes.linux import cpu_seconds, disk_free_percent, raise_descriptor_limit, resident_bytes
from rse_pf.server.gateway.audit_recorder import ServerAudit
from rse_pf.server.gateway.migration import plan
from rse_pf.server.jobs.slots import make_slot_file
from rse_pf.server.log import JsonLog
from rse_pf.server.metrics import merge, merge_isolation, render, tenant_cpu_s
from rse_pf.server.supervisor.accepting import RobotAcceptor
from rse_pf.server.supervisor.crash_recovery import CrashRecovery, spare_plans
from rse_pf.server.supervisor.listener import bound_socket, check_authentication, open_control
from rse_pf.server.supervisor.orders import (
    BlocksOrder,
    DrainOrder,
    LeaveOrder,
    MigrateOrder,
    ReloadServicesOrder,
    RobotsOrder,
    UnblockOrder,
)
from rse_pf.server.supervisor.session_registry import SessionRegistry
from rse_pf.server.supervisor.trust_poller import poll_trust
from rse_pf.server.supervisor.worker import WorkerPlan
from rse_pf.server.supervisor.worker_handle import BUILTIN, RowsOrder, WorkerProcess, fork_workers
from rse_pf.server.worker_context import NullServerRecorder, ServerRecorder
from rse_pf.storage.files import replace_json
from rse_pf.version import installed_version

__all__ = ["serve"]

_FRESH_S = 0.25  # seconds for which reports of the workers are reused: several readers then cost one report
_REPORT_S = 0.3  # seconds to wait for a worker's report; after that, its last report is used
_ROWS_S = 2.0  # seconds to wait for a worker's rows; after that, the answer counts the worker as silent
_LEAVE_S = 3.0  # seconds, after held commands, in which workers must exit; then they are killed
_MAX_MOVES = 10000  # robots of one migration: the default of ``serving.max_robots``
_MAX_BLOCKS = 2000  # rows in one answer of /blocks and /unblock
_MAX_ROBOTS = 1000  # rows in one answer of /robots
_MAX_SPREAD_S = 3600.0  # longest duration of a migration, in seconds, that /move accepts
_MAX_DRAIN_WAIT_S = 3600.0  # longest wait before robots are asked to move, in seconds, that /drain accepts
_EXIT_OK = 0  # exit code after a drain or a signal
_EXIT_LOST = 1  # exit code after a worker was lost, or did not start in time
_PUBLIC_PAGES = ("/healthz", "/readyz")  # pages without a token: load balancers request them


def serve(
    settings: PlatformSettings,
    *,
    placement: ServerPlacement | None = None,
    keys: KeySet | None = None,
    trust: TrustStore | None = None,
    server_id: str,
    announce: Path | None = None,
    conformance_echo: bool = False,
    services: str = BUILTIN,
    audit: Path | None = None,
    control_token: str | None = None,
    recorder: ServerRecorder | None = None,
) -> int:
    """Serve robots until a drain or a signal; call this in the main thread of a process.

    Args:
        settings: The settings that all servers of the platform share; /healthz shows their digest.
        placement: Addresses, workers and store of this server; None takes those of *settings*.
        keys: Public keys of robots' tokens, for the whole run; None only where ``auth.required`` is false.
        trust: Reads public keys, roster and deny list, now and periodically; then *keys* is not used.
        server_id: Name of this server in every Welcome, Result and log line.
        announce: File for process ids and ports, as JSON; written when all workers are ready, and deleted at
            the exit.
        conformance_echo: Echo all messages without token or sub-protocol, for WebSocket conformance suites.
        services: ``module:function`` that makes the registry of a worker from the settings.
        audit: Folder of the audit log; None records nothing.
        control_token: Token that the control port requires for all but its two health pages; None: no token.
        recorder: Records the messages of robots and of this server; None records nothing.

    Returns:
        0 after a drain or a signal; 1 if a worker was lost, or did not start in time.

    Raises:
        ConfigurationError: There are no keys, robots could connect from other machines without a token, or
            the port is taken.
    """
    if trust is not None:
        trust.load()
        keys = trust.keys
    digest = settings.digest()
    if placement is not None:
        settings = placement.apply(settings)
    check_authentication(settings, keys, conformance_echo)
    raise_descriptor_limit()
    count = settings.serving.workers or len(os.sched_getaffinity(0))
    slots = make_slot_file()
    recorder = recorder or NullServerRecorder()
    with recorder:
        plans = [
            WorkerPlan(
                settings=settings, keys=keys if settings.auth.required else None, server_id=server_id,
                services=services, workers=count, index=index, job_slots=slots, supervisor=os.getpid(),
                conformance_echo=conformance_echo, audit=audit is not None,
                recorder=recorder,
            )
            for index in range(count)
        ]  # fmt: skip
        with bound_socket(settings.serving.host, settings.serving.port) as listener:
            processes = fork_workers([*plans, *spare_plans(plans)], listener=listener)
            workers, spares = processes[:count], processes[count:]
            recorder.leave_to_workers()
            try:
                log = JsonLog(
                    level=settings.serving.log_level, server=server_id, wall_clock=time.time
                ).start()
                with (
                    closing(log),
                    ServerAudit(
                        audit, server_id, on_problem=lambda problem: log.error("audit-failed", reason=problem)
                    ) as records,
                ):
                    identity = _Identity(
                        server_id=server_id, digest=digest, announce=announce, control_token=control_token
                    )
                    supervisor = _Supervisor(
                        settings, identity, _Processes(workers=workers, spares=spares, others=recorder.pids),
                        trust=trust, listener=listener, log=log, records=records,
                    )  # fmt: skip
                    return run_in_loop(supervisor.run())
            finally:
                for process in processes:
                    process.kill()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Identity:
    """Name of a server, digest of its settings, and *announce* and *control_token* of `serve`."""

    server_id: str
    digest: str
    announce: Path | None
    control_token: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Processes:
    """The processes of a server: workers, spare processes that replace crashed workers, and ids of others."""

    workers: list[WorkerProcess]
    spares: list[WorkerProcess]
    others: list[int]

    def pids(self) -> list[int]:
        return [os.getpid(), *(worker.pid for worker in self.workers), *self.others]


class _Supervisor:
    """The state of a server: starting, ready, draining or leaving, and its processes and control port."""

    def __init__(
        self,
        settings: PlatformSettings,
        identity: _Identity,
        processes: _Processes,
        *,
        trust: TrustStore | None,
        listener: socket.socket,
        log: JsonLog,
        records: ServerAudit,
    ) -> None:
        self._settings = settings
        self._processes = processes
        self._digest = identity.digest
        self._server_id = identity.server_id
        self._records = records
        self._announce = identity.announce
        self._port = listener.getsockname()[1]
        self._state = "starting"
        self._began = time.monotonic()
        self._reported = float("-inf")
        self._reporting = asyncio.Lock()
        self._asking_rows = asyncio.Lock()
        self._asked_rows = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._control_port = 0
        self._moving_until = 0.0
        self._signals = 0
        self._refused_full = 0
        self._trust = trust if settings.auth.required else None
        self._acceptor = RobotAcceptor(
            listener, settings.serving, silent_s=settings.session.hello_timeout_s, pass_on=self._pass_on,
            on_refused=lambda reason: self._log.warning("accept-failed", reason=reason),
        )  # fmt: skip
        self._control_refused = 0
        self._control_token = identity.control_token
        self._log = log
        self._workers = processes.workers
        self._registry = SessionRegistry()
        self._crashes = CrashRecovery(
            self._workers, processes.spares, registry=self._registry, trust=self._trust, log=self._log,
            records=records,
        )  # fmt: skip

    async def run(self) -> int:
        """Start the server, serve until a drain, a signal or a lost worker, and return the exit code."""
        loop = asyncio.get_running_loop()
        self._over: asyncio.Future[int] = loop.create_future()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._on_signal, number)
        control = await open_control(self._settings.serving, self._answer)
        self._control_port = control.sockets[0].getsockname()[1]
        try:
            await self._start(loop)
            return await self._over
        finally:
            self._acceptor.close()
            control.close()
            for worker in self._workers:
                worker.kill()
            if self._announce is not None:
                self._announce.unlink(missing_ok=True)
            code = self._over.result() if self._over.done() else None
            self._log.info("server-over", exit_code=code)
            self._records.note("server.over", exit_code=code)

    async def _start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Connect to the workers and accept robots; finish with 1 if a worker is not ready in time."""
        readiness = [
            loop.create_task(worker.connect(on_lost=self._on_lost, on_message=self._on_message))
            for worker in self._workers
        ]
        everything = asyncio.gather(*readiness)
        either: list[asyncio.Future[Any]] = [self._over, everything]
        await asyncio.wait(
            either,
            timeout=self._settings.local.start_timeout_s,
            return_when=asyncio.FIRST_COMPLETED,
        )
        if self._over.done() or not everything.done():
            everything.cancel()
            with suppress(asyncio.CancelledError):
                await everything
            self._finish(_EXIT_LOST)
            return
        self._acceptor.open()
        self._state = "ready"
        if self._announce is not None:
            replace_json(self._announce, self._announcement())
        if self._trust is not None:
            self._keep(poll_trust(self._trust, self._workers, self._log))
        self._log.info("server-ready", **self._announcement(), settings=self._digest)
        self._records.note("server.ready", settings=self._digest)

    def _announcement(self) -> dict[str, Any]:
        """Return the name, process ids and ports of the server, as `serve` announces them."""
        return {
            "server": self._server_id,
            "pid": os.getpid(),
            "port": self._port,
            "control_port": self._control_port,
            "workers": [worker.pid for worker in self._workers],
        }

    def _pass_on(self, fd: int, number: int, peer: str) -> None:
        """Send an accepted socket to the worker with the fewest sockets; if its channel is full, to another.

        If the channels of all workers are full, the socket is refused.
        """
        if min(self._workers, key=_load_of).give(fd, number, peer):
            return
        for worker in sorted(self._workers, key=_load_of)[1:]:  # the channel of the first worker is full
            if worker.give(fd, number, peer):
                return
        self._refused_full += 1

    def _on_message(self, worker: WorkerProcess, message: dict[str, Any]) -> None:
        """Handle a message of a worker: notes for the audit log, or an event of one robot's connection."""
        if message["event"] == "audit":
            self._records.add(message["notes"])
        else:
            self._registry.handle(worker, message)

    def _on_lost(self, worker: WorkerProcess) -> None:
        """Replace a worker that crashed; after any other exit of a worker, exit, unless the server leaves."""
        serves = self._state in ("ready", "draining")
        replacement = self._crashes.replace(worker, time.monotonic()) if serves else None
        if replacement is not None:
            self._keep(self._connect_replacement(replacement))
            if self._announce is not None:
                replace_json(self._announce, self._announcement())
        elif self._state != "leaving":
            self._log.error("worker-lost", pid=worker.pid, exit_code=worker.exit_code())
            self._finish(_EXIT_LOST)

    async def _connect_replacement(self, worker: WorkerProcess) -> None:
        """Wait until *worker*, which replaces a crashed one, is ready; repeat the order of a drain to it."""
        await worker.connect(on_lost=self._on_lost, on_message=self._on_message)
        if self._state == "draining":
            worker.order(DrainOrder(MOVE_WITHIN_MS))
        elif self._state == "leaving":
            worker.order(LeaveOrder(0.0))

    def _on_signal(self, number: signal.Signals) -> None:
        """Drain the server at SIGTERM; exit at once at SIGINT, at a second signal, or during the start."""
        self._signals += 1
        if number == signal.SIGINT or self._signals > 1 or self._state == "starting":
            self._keep(self._leave(held_s=0.0))
        elif self._state == "ready":
            self._keep(self._drain(self._settings.serving.drain_wait_s))

    async def _drain(self, wait_s: float) -> None:
        """Drain the server without losing a command.

        1. Report not ready for *wait_s* seconds, but accept robots: the load balancer needs this time to stop
           sending new ones.
        2. Ask all robots to move to another server, and wait until they have, at most `MOVE_WITHIN_MS`.
        3. Answer the received commands, at most for ``session.answer_timeout_s``, close the sockets and exit.
        """
        self._state = "draining"
        self._log.info("drain", wait_s=wait_s)
        self._records.note("server.drain", wait_s=wait_s)
        await asyncio.sleep(wait_s)
        for worker in self._workers:
            worker.order(DrainOrder(MOVE_WITHIN_MS))
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._wait_empty(), MOVE_WITHIN_MS / 1e3)
        await self._leave(self._settings.session.answer_timeout_s)

    async def _wait_empty(self) -> None:
        """Wait until no worker has a robot, including workers that replaced a crashed one meanwhile."""
        while waiting := [worker for worker in self._workers if not worker.empty.is_set()]:
            await waiting[0].empty.wait()

    async def _leave(self, held_s: float) -> None:
        """Order the workers to answer commands for at most *held_s* seconds and exit; then finish with 0."""
        if self._state == "leaving" and held_s > 0:
            return
        self._state = "leaving"
        self._acceptor.close()
        for worker in self._workers:
            worker.order(LeaveOrder(held_s))
        all_exited = asyncio.gather(*(worker.exited.wait() for worker in self._workers))
        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(all_exited, held_s + _LEAVE_S)
        self._finish(_EXIT_OK)

    def _finish(self, code: int) -> None:
        """Let `run` return *code*, unless it has a code already."""
        self._state = "leaving"
        if not self._over.done():
            self._over.set_result(code)

    def _keep(self, work: Any) -> None:
        """Run the coroutine *work* as a task, and hold a reference to the task until it is done."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, ask: ControlRequest) -> ControlReply:
        """Answer one request to the control port, after its token was checked."""
        pages: dict[tuple[str, str], Callable[[ControlRequest], Awaitable[ControlReply]]] = {
            ("GET", "/healthz"): self._healthz,
            ("GET", "/readyz"): self._readyz,
            ("GET", "/metrics"): self._metrics,
            ("GET", "/status"): self._status,
            ("GET", "/blocks"): self._blocks,
            ("GET", "/robots"): self._robots,
            ("POST", "/unblock"): self._post_unblock,
            ("POST", "/services"): self._post_services,
            ("POST", "/drain"): self._post_drain,
            ("POST", "/move"): self._post_move,
        }
        token = self._control_token
        if (
            token is not None
            and ask.path not in _PUBLIC_PAGES
            and not carries_token(ask.authorization, token)
        ):
            self._control_refused += 1
            return json_reply({"code": "unauthorized"}, status=401, headers={"WWW-Authenticate": "Bearer"})
        page = pages.get((ask.method, ask.path))
        if page is not None:
            return await page(ask)
        known = any(path == ask.path for _, path in pages)
        return json_reply({"code": "not-found"}, status=405 if known else 404)

    async def _healthz(self, ask: ControlRequest) -> ControlReply:
        """Return name, version, settings digest and uptime; the status is 200 as long as the server runs."""
        return json_reply(
            {
                "server": self._server_id,
                "version": installed_version(),
                "settings": self._digest,
                "uptime_s": round(time.monotonic() - self._began, 3),
            }
        )

    async def _readyz(self, ask: ControlRequest) -> ControlReply:
        """Return status 200 if the server accepts robots, and 503 while it starts, drains or leaves.

        With installed services, the page also has what their isolation lacks, and open circuit breakers.
        """
        readiness: dict[str, Any] = {"state": self._state}
        if self._settings.services.folder or self._settings.services.published:
            await self._merge_reports()
            isolation = merge_isolation(worker.report for worker in self._workers)
            readiness.update(
                missing_isolation=isolation["missing_isolation"], open_breakers=isolation["open_breakers"]
            )
        if self._state == "ready":
            return json_reply(readiness)
        return json_reply(readiness, status=503, headers={"x-envoy-immediate-health-check-fail": "1"})

    async def _metrics(self, ask: ControlRequest) -> ControlReply:
        """Return the metrics of all workers and of the supervisor in the text format of Prometheus."""
        merged = await self._merge_reports()
        merged["gauges"].update(
            {
                "cpu_s": self._cpu_s(merged["gauges"]),
                "resident_bytes": float(sum(map(resident_bytes, self._processes.pids()))),
                "ready": float(self._state == "ready"),
                "accept_pauses": float(self._acceptor.pauses),
                "control_refused": float(self._control_refused),
                "worker_crashes": float(self._crashes.count),
                "disk_free_percent": disk_free_percent(),
            }
        )
        return ControlReply(body=render(merged), content_type="text/plain; version=0.0.4; charset=utf-8")

    async def _status(self, ask: ControlRequest) -> ControlReply:
        """Return the state, load, results, CPU seconds and memory of the server as JSON, for operators."""
        merged = await self._merge_reports()
        gauges = merged["gauges"]
        results: dict[str, int] = {}
        for _, result, n in merged["requests"]:
            results[result] = results.get(result, 0) + n
        return json_reply(
            {
                **self._announcement(),
                "version": installed_version(),
                "state": self._state,
                "uptime_s": round(time.monotonic() - self._began, 3),
                "robots": int(gauges.get("robots", 0)),
                "robots_of_workers": [worker.load for worker in self._workers],
                "requests": sum(results.values()),
                "results": results,
                "queue": int(gauges.get("queue", 0)),
                "queue_oldest_s": gauges["queue_oldest_s"],
                "queue_ms": round(gauges["queue_ms"], 3),
                "in_flight": int(gauges.get("in_flight", 0)),
                "loop_lag_s": gauges["loop_lag_s"],
                "bytes_in": int(merged["bytes"].get("in", 0)),
                "bytes_out": int(merged["bytes"].get("out", 0)),
                "moved": int(gauges.get("moved", 0)),
                "cpu_s": self._cpu_s(merged["gauges"]),
                "tenant_cpu_s": tenant_cpu_s(merged),
                "worker_cpu_s": [cpu_seconds(worker.pid) for worker in self._workers],
                "resident_bytes": sum(map(resident_bytes, self._processes.pids())),
                "emulated_cores": self._settings.serving.emulated_cores,
                "settings": self._digest,
                "isolation": merge_isolation(worker.report for worker in self._workers),
            }
        )

    async def _blocks(self, ask: ControlRequest) -> ControlReply:
        """Return rows for at most `_MAX_BLOCKS` refusals after crashes; ``count`` is the number of all."""
        return json_reply(await self._ask_rows("blocks", BlocksOrder, _MAX_BLOCKS))

    async def _robots(self, ask: ControlRequest) -> ControlReply:
        """Return rows for at most `_MAX_ROBOTS` connected robots; ``count`` is the number of all of them."""
        return json_reply(await self._ask_rows("robots", RobotsOrder, _MAX_ROBOTS))

    async def _post_unblock(self, ask: ControlRequest) -> ControlReply:
        """Lift refusals after crashes: those that the query selects by service, tenant and robot, or all."""
        scope = {name: ask.query.get(name) for name in ("service", "tenant", "robot")}
        if not ask.is_local:
            return refused_reply(403, "forbidden", "unblock from the server's own machine")
        if set(ask.query) - set(scope) or (scope["robot"] and not scope["tenant"]):
            return refused_reply(
                400, "bad-request", "name a service, a tenant, a robot of that tenant, or nothing"
            )
        answer = await self._ask_rows("blocks", lambda number: UnblockOrder(number, **scope), _MAX_BLOCKS)
        self._log.info("unblock", **scope, lifted=answer["count"])
        self._records.note("server.unblock", **scope, lifted=answer["count"])
        return json_reply(answer)

    async def _ask_rows(self, key: str, make_order: Callable[[int], RowsOrder], most: int) -> dict[str, Any]:
        """Send an order to all workers, and return their rows, at most *most*, under the name *key*.

        A row that several workers report is repeated.  ``count`` is the number of all rows, and
        ``silent_workers`` the number of workers without an answer within `_ROWS_S`.
        """
        async with self._asking_rows:
            self._asked_rows += 1
            order = make_order(self._asked_rows)
            replies = await asyncio.gather(*(worker.ask_rows(order, _ROWS_S) for worker in self._workers))
        answers = [reply for reply in replies if reply is not None]
        rows = [row for answer in answers for row in answer["rows"]]
        return {
            "server": self._server_id,
            "order": order.number,
            key: rows[:most],
            "count": sum(answer["count"] for answer in answers),
            "silent_workers": len(replies) - len(answers),
        }

    async def _post_services(self, ask: ControlRequest) -> ControlReply:
        """Order the workers to load the services folder again; later /status shows what every worker runs."""
        if not (ask.is_local and self._settings.services.follow):
            return refused_reply(
                403, "forbidden", "reload services from the server's own machine, and with --follow-services"
            )
        for worker in self._workers:
            worker.order(ReloadServicesOrder())
        self._records.note("server.services")
        return json_reply({"workers": len(self._workers)}, status=202)

    async def _post_drain(self, ask: ControlRequest) -> ControlReply:
        """Begin to drain the server; ``wait`` in the query replaces ``serving.drain_wait_s``."""
        if not ask.is_local:
            return refused_reply(403, "forbidden", "drain from the server's own machine")
        try:
            wait_s = number_of(ask, "wait", self._settings.serving.drain_wait_s, _MAX_DRAIN_WAIT_S)
        except ValueError:
            return refused_reply(400, "bad-request", f"wait is 0 to {_MAX_DRAIN_WAIT_S:g} seconds")
        if self._state == "ready":
            self._state = "draining"
            self._keep(self._drain(wait_s))
        return json_reply({"state": self._state}, status=202)

    async def _post_move(self, ask: ControlRequest) -> ControlReply:
        """Begin a migration of as many robots as the query says, unless an earlier migration still runs."""
        try:
            robots = int(ask.query["robots"])
            spread_s = number_of(ask, "spread_s", 0.0, _MAX_SPREAD_S)
        except (KeyError, ValueError):
            robots = -1
            spread_s = 0.0
        if not ask.is_local:
            return refused_reply(403, "forbidden", "move from the server's own machine")
        if not 0 <= robots <= _MAX_MOVES:
            return refused_reply(
                400, "bad-request", f"robots is 0 to {_MAX_MOVES}, spread_s 0 to {_MAX_SPREAD_S:g} seconds"
            )
        if self._state != "ready":
            return refused_reply(409, "draining", "this server drains: all its robots are asked to move")
        left_s = self._moving_until - time.monotonic()
        if left_s > 0:
            return json_reply({"robots": 0, "spread_s": round(left_s, 3), "under_way": True}, status=202)
        asked, last_s = self._migrate(robots, spread_s)
        return json_reply({"robots": asked, "spread_s": last_s, "under_way": False}, status=202)

    def _migrate(self, robots: int, spread_s: float) -> tuple[int, float]:
        """Order the workers to ask at most *robots* robots to move to another server.

        The requests are spread over *spread_s* seconds, or longer if they were more than `MOVES_PER_S`.
        Return how many robots are asked, and the seconds until the last one of them is asked.
        """
        delays = plan(
            [worker.load for worker in self._workers], robots, spread_s=spread_s,
            moves_per_s=MOVES_PER_S, random=random.random,
        )  # fmt: skip
        asked = sum(map(len, delays))
        last_s = max((delays_s[-1] for delays_s in delays if delays_s), default=0.0)
        self._moving_until = time.monotonic() + last_s
        for worker, delays_s in zip(self._workers, delays, strict=True):
            if delays_s:
                worker.order(MigrateOrder(delays_s, MOVE_WITHIN_MS))
        self._log.info("migration", robots=asked, spread_s=round(last_s, 3))
        self._records.note("server.move", robots=asked, spread_s=round(last_s, 3))
        return asked, round(last_s, 3)

    async def _merge_reports(self) -> dict[str, Any]:
        """Return the sum of the workers' reports, with the counts of the supervisor added.

        Reports are at most `_FRESH_S` old; of a worker that does not answer in time, the last report counts.
        """
        async with self._reporting:
            if time.monotonic() - self._reported >= _FRESH_S:
                await asyncio.gather(*(worker.ask_report(_REPORT_S) for worker in self._workers))
                self._reported = time.monotonic()
        merged = merge(worker.report for worker in self._workers if worker.report is not None)
        merged["handshakes"]["no-worker"] = self._refused_full
        merged["closed"]["unauthenticated"] = merged["closed"].get("unauthenticated", 0) + self._acceptor.cut
        return merged

    def _cpu_s(self, gauges: Mapping[str, float]) -> float:
        """Return the CPU seconds of all processes of the server since its start, crashed workers included.

        *gauges* has those of limited processes, which the workers report.
        """
        running_s = sum(map(cpu_seconds, self._processes.pids())) + gauges.get("compute_cpu_s", 0.0)
        return round(running_s + self._crashes.cpu_s, 3)


def _load_of(worker: WorkerProcess) -> tuple[bool, int]:
    """Return a sort key: workers that are ready come first, then those with fewer sockets."""
    return not worker.is_ready, worker.load
