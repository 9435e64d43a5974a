"""One worker process, forked by the supervisor (`worker_handle`).

Accepted sockets arrive as descriptors on the data channel, and orders (`orders`) on the control channel.  A
worker exits when its supervisor exits: by the parent-death signal, or when its control channel is closed.  It
ignores SIGINT and SIGTERM, which a terminal or a service manager also sends to the supervisor.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import secrets
import signal
import socket
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import key_set_from_snapshot
from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings, ServiceSettings
from rse_pf.errors import ConfigurationError, RsePfError, message_of
from rse_pf.identity import RobotId
from rse_pf.processes.event_loop import event_loop_maker
from rse_pf.processes.ipc import receive_bytes
from rse_pf.processes.linux import die_with_parent, set_process_name
from rse_pf.server.compute.limited_services import LimitedServices, limited_processes
from rse_pf.server.gateway.answers import Answers
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.dispatcher import Dispatcher
from rse_pf.server.gateway.handshake import HandshakePolicy
from rse_pf.server.gateway.migration import Migration
from rse_pf.server.gateway.service_queues import LimitedQueue
from rse_pf.server.gateway.token_watch import TokenWatch
from rse_pf.server.jobs.manager import JobManager
from rse_pf.server.jobs.process import spawner
from rse_pf.server.jobs.runner import JobContext
from rse_pf.server.jobs.slots import JobSlots
from rse_pf.server.live_map.client import LiveMapClient
from rse_pf.server.live_map.router import LIVE_SERVICES, LiveMapRouter
from rse_pf.server.log import JsonLog
from rse_pf.server.object_refs import ObjectRefs
from rse_pf.server.robot_store import is_shared
from rse_pf.server.sandbox.circuit_breaker import Block
from rse_pf.server.sandbox.manager import SandboxHost, SandboxManager
from rse_pf.server.sandbox.reloading import Answer, OnReady, ReloadingSandboxes
from rse_pf.server.scheduling.command_queue import CommandQueue
from rse_pf.server.supervisor.crash_report import CrashReport
from rse_pf.server.supervisor.orders import (
    BanOrder,
    BeginOrder,
    BlocksOrder,
    DrainOrder,
    LeaveOrder,
    MigrateOrder,
    ReloadServicesOrder,
    ReplaceOrder,
    ReportOrder,
    RobotsOrder,
    TrustOrder,
    UnblockOrder,
    WorkerOrder,
    decode_order,
)
from rse_pf.server.supervisor.robot_reports import MAX_ROBOT_ROWS, RobotEvents, robot_rows
from rse_pf.server.worker_context import Clocks, NullServerRecorder, ServerRecorder, WorkerContext
from rse_pf.services.custom.installed import InstalledService, installed_services, packaged_services
from rse_pf.services.loading import load_services
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire.server_session import CLOSE_RATE

__all__ = ["BEGIN_LENGTH", "HANDOVER", "WorkerPlan", "repeat_for", "run_worker"]

HANDOVER = struct.Struct("!Q46s")
"""A message on the data channel: number of a socket and address of its peer, sent with its descriptor."""
BEGIN_LENGTH = struct.Struct("!I")
"""The first bytes on the control channel of a spare process: the length of the `BeginOrder` behind them."""
_DESCRIPTOR = struct.Struct("@i")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_DESCRIPTOR.size)
_T = TypeVar("_T")
_TAKE_S = 0.0005  # seconds for new sockets in one round of the event loop, so that robots are served, too
_POLL_S = 0.01  # seconds between two checks whether all connections are closed, or all commands answered
_GATHER_S = 0.01  # seconds in which closed sockets are reported together: each message wakes the supervisor
_MAX_LINE_BYTES = 1 << 26  # bytes of the longest order: a `TrustOrder` contains every enrolled robot
_CLOSE_TIMEOUT_S = 1.0  # seconds for closing live maps, and as many for connections, when the worker exits
_MAX_BLOCKS = 500  # rows of refusals in one message to the supervisor: an operator reads no more


@dataclass(frozen=True)
class WorkerPlan:
    """The values with which a worker is forked.

    Attributes:
        settings: The settings of the server.
        keys: Verify tokens until the first `TrustOrder`; None if no tokens are required.
        server_id: Name of the server.
        services: The ``module:function`` that returns the registry of services.
        workers: Number of workers of the server; each has its part of the server's limits.
        index: Index of this worker, from 0; -1 for a spare process.
        job_slots: Descriptor of the file of `make_slot_file`.
        supervisor: Process id of the supervisor.
        conformance_echo: Whether messages are echoed, for conformance suites.
        audit: Whether the server has an audit log.
        crash: Shared memory for the report of a crash in native code.
        is_spare: Whether the process waits for a `BeginOrder`, which gives it the index of a crashed worker.
        recorder: Records messages.
    """

    settings: PlatformSettings
    keys: KeySet | None
    server_id: str
    services: str
    workers: int
    index: int
    job_slots: int
    supervisor: int
    conformance_echo: bool = False
    audit: bool = False
    crash: CrashReport = field(default_factory=CrashReport)
    is_spare: bool = False
    recorder: ServerRecorder = field(default_factory=NullServerRecorder)


def repeat_for(seconds: float, step: Callable[[], bool], clock: Callable[[], float]) -> None:
    """Call *step* at least once, and again until it returns False or *seconds* have passed by *clock*."""
    until = clock() + seconds
    while step() and clock() < until:
        pass


def run_worker(plan: WorkerPlan, data: socket.socket, control: socket.socket) -> None:
    """Serve robots until a `LeaveOrder`, or until the supervisor exits; the main function of a worker.

    A spare process first waits for its `BeginOrder`.  *data* and *control* are the worker's channels.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if not die_with_parent(plan.supervisor):
        return
    set_process_name("rse-pf spare" if plan.is_spare else "rse-pf worker")
    begin = _wait_to_begin(control) if plan.is_spare else None
    if plan.is_spare and begin is None:
        return
    set_process_name("rse-pf worker")
    plan.crash.begin()
    if begin is not None:
        time.sleep(begin.wait_s)
        plan = _plan_of(plan, begin)
    loop = event_loop_maker()()
    asyncio.set_event_loop(loop)
    log = JsonLog(level=plan.settings.serving.log_level, server=plan.server_id, wall_clock=time.time)
    log.start()
    worker = _Worker(plan, data, control, loop, log)
    if begin is not None:
        for robot, seconds in begin.banned:
            worker.ban(robot, seconds)
    loop.run_until_complete(worker.run())


def _wait_to_begin(control: socket.socket) -> BeginOrder | None:
    """Wait for the order by which a spare process replaces a worker; None if the supervisor has exited."""
    head = receive_bytes(control, BEGIN_LENGTH.size)
    size = BEGIN_LENGTH.unpack(head)[0] if len(head) == BEGIN_LENGTH.size else 0
    line = receive_bytes(control, size)
    order = decode_order(line) if size and len(line) == size else None
    return order if isinstance(order, BeginOrder) else None


def _plan_of(plan: WorkerPlan, order: BeginOrder) -> WorkerPlan:
    """Return the plan of a spare process, with the index and the keys of *order*."""
    keys = key_set_from_snapshot(order.snapshot) if order.snapshot and plan.keys is not None else plan.keys
    return replace(plan, index=order.index, keys=keys)


class _Worker:
    """Builds the parts of a worker from its plan, obeys orders, and receives sockets."""

    def __init__(
        self,
        plan: WorkerPlan,
        data: socket.socket,
        control: socket.socket,
        loop: asyncio.AbstractEventLoop,
        log: JsonLog,
    ) -> None:
        from rse_pf.server.gateway.websocket import RobotSockets  # `warm_up` has imported it

        settings = plan.settings
        self._data = data
        self._control = control
        self._loop = loop
        self._ended = 0
        self._flushing = False
        self._robot_events = RobotEvents(loop, self._send)
        self._tasks: set[asyncio.Task[None]] = set()
        self._log = log
        registry = load_services(plan.services, settings)
        chosen = settings.services
        installed = self._installed_services(chosen)
        context = WorkerContext(
            settings=settings,
            server_id=plan.server_id,
            clocks=Clocks(monotonic=time.monotonic, wall=time.time, cpu=time.process_time),
            loop=loop,
            log=self._log,
            tap=plan.recorder.open_tap(loop.call_later, log),
            crash=plan.crash,
        )
        connections = set[RobotConnection]()
        store = open_data_store(settings) if is_shared(settings) else None
        registry.others = tuple(service.name for service in installed)
        self._registry = registry
        self._answers = answers = Answers(
            context,
            registry=registry,
            services=frozenset(service.name for service in (*registry, *installed)) | LIVE_SERVICES,
            objects=ObjectRefs(store, settings.data),
        )
        handshake = HandshakePolicy(settings, plan.keys, conformance_echo=plan.conformance_echo)
        self._recorder = AuditRecorder(context.clocks, loop=loop, send=self._send, is_on=plan.audit)
        self._token_watch = TokenWatch(
            context,
            connections,
            handshake,
            send=self._robot_events.add,
            recorder=self._recorder,
        )
        self._sandboxes = (
            self._run_services(plan, installed, answers) if chosen.folder or chosen.published else None
        )
        self._live_maps = (
            None if store is None or not settings.live.max_owners else _live_maps(context, answers, store)
        )
        queues: list[CommandQueue | None] = [
            self._sandboxes,
            self._live_maps,
            LimitedQueue(
                context, answers, LimitedServices(context, limited_processes(plan.services, settings))
            ),
            self._jobs(plan, answers) if settings.serving.max_running_jobs else None,
        ]
        self._dispatcher = Dispatcher(
            context,
            answers=answers,
            token_watch=self._token_watch,
            queues=[queue for queue in queues if queue is not None],
            updates=self._live_maps,
        )
        self._migration = Migration(connections, loop=loop, now=time.monotonic, choose=secrets.choice)
        self._index = plan.index
        self._workers = plan.workers
        self._named = 0
        self._sockets = RobotSockets(
            self._dispatcher,
            handshake,
            max_robots=-(-settings.serving.max_robots // self._workers),
            workers=self._workers,
            new_name=self._new_name,
            recorder=self._recorder,
        )

    def _installed_services(self, chosen: ServiceSettings) -> list[InstalledService]:
        """Return the services of the services folder and of published packages.

        If ``services.follow`` is set, the error of a damaged folder is logged, and the folder counts as
        empty.
        """
        published = packaged_services() if chosen.published else []
        if not chosen.folder:
            return published
        if not chosen.follow:
            return installed_services(Path(chosen.folder)) + published
        try:
            return installed_services(Path(chosen.folder).resolve()) + published
        except (RsePfError, OSError) as error:
            self._log.error("services-refused", reason=message_of(error))
            return published

    def _run_services(
        self, plan: WorkerPlan, services: Sequence[InstalledService], answers: Answers
    ) -> ReloadingSandboxes:
        """Return the queue of installed services, with a sandbox manager that is started."""
        settings = plan.settings
        chosen = settings.services

        host = SandboxHost(
            server_id=plan.server_id, loop=self._loop, monotonic=time.monotonic, log=self._log,
            answer=answers.send_message,
        )  # fmt: skip

        def make(
            services: Sequence[InstalledService], *, answer: Answer, on_ready: OnReady | None
        ) -> SandboxManager:
            sandboxes = SandboxManager(
                services,
                settings=settings,
                max_sandboxes=-(-settings.services.max_sandboxes // plan.workers),
                store=open_data_store(settings),
                host=replace(host, answer=answer),
                on_ready=on_ready,
            )
            return sandboxes.start()

        reloading = ReloadingSandboxes(
            make, accepts_weak_isolation=chosen.accept_weak_isolation,
            start_timeout_s=settings.local.start_timeout_s, host=host, on_change=self._offer,
        )  # fmt: skip
        try:
            reloading.start(services)
        except ConfigurationError as error:
            if not chosen.follow:
                raise
            self._log.error("services-refused", reason=error.message)
            self._offer(())
        return reloading

    def _offer(self, names: tuple[str, ...]) -> None:
        """Set the names of installed services in the registry and in answers to *names*."""
        self._registry.others = names
        self._answers.offer(
            frozenset((*names, *(service.name for service in self._registry))) | LIVE_SERVICES
        )

    async def _reload_services(self) -> None:
        """Load the services folder again in a thread, and replace the installed services.

        This may take seconds, since every file is compared with its digest.  If it fails, the error is logged
        and the present services stay.
        """
        chosen = self._dispatcher.context.settings.services
        if self._sandboxes is None or not chosen.follow:
            return
        folder = Path(chosen.folder).resolve()
        try:
            services = await self._loop.run_in_executor(None, installed_services, folder)
        except (RsePfError, OSError) as error:
            self._log.error("services-refused", reason=message_of(error))
            return
        self._sandboxes.replace(services + (packaged_services() if chosen.published else []))

    def _jobs(self, plan: WorkerPlan, answers: Answers) -> JobManager:
        """Return the queue of long services, whose commands run as jobs."""
        settings = plan.settings
        store = open_data_store(settings)
        context = JobContext(
            store=store,
            slots=JobSlots(plan.job_slots, settings.serving.max_running_jobs),
            settings=settings,
            server_id=plan.server_id,
            start=spawner(plan.services, settings),
            clock=time.monotonic,
            services=frozenset(service.name for service in self._registry if service.kind == "long"),
        )
        return JobManager(
            context, loop=self._loop, log=self._log, answer=answers.send_message,
            progress=RobotConnection.write_progress,
            owner=f"{plan.server_id}-{secrets.token_hex(8)}",
        )  # fmt: skip

    async def run(self) -> None:
        """Obey orders until a `LeaveOrder` or the end of the control channel, then exit the process."""
        reader, self._writer = await asyncio.open_unix_connection(sock=self._control, limit=_MAX_LINE_BYTES)
        self._data.setblocking(False)
        self._loop.add_reader(self._data.fileno(), self._take_sockets)
        self._dispatcher.start()
        gc.collect()
        gc.freeze()
        self._send(event="ready")
        while line := await reader.readline():
            order = decode_order(line)
            self._obey(order)
            if isinstance(order, LeaveOrder):
                await self._leave(order.held_s)
                break
        self._recorder.flush()
        self._robot_events.flush()
        self._dispatcher.context.tap.flush()
        self._log.close()
        os._exit(0)  # without waiting for the remaining sockets and threads

    def _obey(self, order: WorkerOrder) -> None:
        """Carry out one order of the supervisor; a `LeaveOrder` is left to `run`."""
        match order:
            case ReportOrder():
                self._send(event="report", report=self._report())
            case DrainOrder():
                self._dispatcher.move_all("drain", order.within_ms)
                self._keep(self._report_when_empty())
            case MigrateOrder():
                self._migration.begin(order.delays_s, order.within_ms)
            case BanOrder():
                self.ban(order.robot, order.seconds)
            case TrustOrder():
                self._token_watch.trust(key_set_from_snapshot(order.snapshot))
            case ReplaceOrder():
                self._token_watch.replace(order.number)
            case BlocksOrder():
                self._send_blocks(order.number, [] if self._sandboxes is None else self._sandboxes.blocks())
            case RobotsOrder():
                rows = robot_rows(self._dispatcher.connections, time.monotonic())
                self._send_rows(order.number, len(rows), rows[:MAX_ROBOT_ROWS])
            case UnblockOrder(number, service, tenant, robot):
                sandboxes = self._sandboxes
                lifted = [] if sandboxes is None else sandboxes.unblock(service, tenant, robot)
                self._send_blocks(number, lifted)
            case ReloadServicesOrder():
                self._keep(self._reload_services())

    def ban(self, robot: RobotId, seconds: float) -> None:
        """Close all connections of *robot*, and reject its handshakes for *seconds*."""
        self._dispatcher.rates.ban(robot, time.monotonic(), seconds)
        for connection in [live for live in self._dispatcher.connections if live.robot == robot]:
            connection.close(CLOSE_RATE, "crashes")

    def _report(self) -> dict[str, Any]:
        report = self._dispatcher.snapshot()
        report["gauges"]["moved"] = float(self._migration.asked)
        return report

    def _send_blocks(self, number: int, blocks: list[Block]) -> None:
        self._send_rows(number, len(blocks), [asdict(block) for block in blocks[:_MAX_BLOCKS]])

    def _send_rows(self, number: int, count: int, rows: list[dict[str, Any]]) -> None:
        self._send(event="rows", number=number, count=count, rows=rows)

    async def _report_when_empty(self) -> None:
        """Report to the supervisor when no robot is connected any more."""
        while self._dispatcher.connections:
            await asyncio.sleep(_POLL_S)
        self._send(event="empty")

    async def _leave(self, held_s: float) -> None:
        """Wait at most *held_s* until all commands are answered, then close all connections and live maps."""
        until = time.monotonic() + held_s
        while self._dispatcher.held and time.monotonic() < until:
            await asyncio.sleep(_POLL_S)
        self._dispatcher.close_all()
        if self._live_maps is not None:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._live_maps.wait_closed(), _CLOSE_TIMEOUT_S)
        until = time.monotonic() + _CLOSE_TIMEOUT_S
        while self._dispatcher.connections and time.monotonic() < until:
            await asyncio.sleep(_POLL_S)

    def _take_sockets(self) -> None:
        repeat_for(_TAKE_S, self._take_socket, time.monotonic)

    def _take_socket(self) -> bool:
        """Receive one socket from the supervisor; return False if there is none, or if handshakes wait."""
        try:
            message, ancillary, _, _ = self._data.recvmsg(HANDOVER.size, _ANCILLARY_BYTES)
        except BlockingIOError:
            return False
        if not message:
            self._loop.remove_reader(self._data.fileno())
            return False
        number, peer = HANDOVER.unpack(message)
        for _, _, packed in ancillary:
            (fd,) = _DESCRIPTOR.unpack(packed)
            self._sockets.take(fd, self._count_end, number, peer.rstrip(b"\0").decode())
        return not self._sockets.is_behind

    def _count_end(self) -> None:
        """Count a closed socket, and report it to the supervisor within `_GATHER_S`."""
        self._ended += 1
        if not self._flushing:
            self._flushing = True
            self._loop.call_later(_GATHER_S, self._flush_ends)

    def _flush_ends(self) -> None:
        """Send the supervisor one byte for each closed socket, from which it computes this worker's load."""
        self._flushing = False
        try:
            self._ended -= self._data.send(b"e" * self._ended)
        except BlockingIOError:
            self._flushing = True
            self._loop.call_later(_POLL_S, self._flush_ends)
        except OSError:
            self._ended = 0  # the supervisor has exited, so that this process exits, too

    def _new_name(self) -> str:
        """Return a name for a robot without a token, unique among the workers of the server."""
        self._named += 1
        return f"anonymous-{(self._named - 1) * self._workers + self._index + 1}"

    def _send(self, **message: Any) -> None:
        self._writer.write(msgspec.json.encode(message) + b"\n")

    def _keep(self, work: Any) -> None:
        """Run the coroutine *work* as a task, and hold a reference to the task until it is done."""
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _live_maps(context: WorkerContext, answers: Answers, store: ObjectStore) -> LiveMapRouter:
    """Return the queue of live maps, which also handles subscriptions to them."""

    def make_client(on_update: Callable[[str, str, dict[str, Any]], None]) -> LiveMapClient:
        return LiveMapClient(
            store=store, settings=context.settings, server_id=context.server_id, log=context.log,
            on_update=on_update,
        )  # fmt: skip

    return LiveMapRouter(context, make_client=make_client, answer=answers.send_message)
