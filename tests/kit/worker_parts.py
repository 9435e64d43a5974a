"""The parts of one worker on a `FakeLoop`, put together as `rse_pf.server.supervisor.worker` does it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from rse_pf.auth.tokens import Claims, KeySet
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.processes.limited import LimitedProcesses
from rse_pf.server.compute.limited_services import LimitedServices
from rse_pf.server.gateway.answers import Answers
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.dispatcher import Dispatcher
from rse_pf.server.gateway.handshake import Accepted, HandshakePolicy
from rse_pf.server.gateway.service_queues import LimitedQueue
from rse_pf.server.gateway.token_watch import TokenWatch
from rse_pf.server.live_map.router import LiveMapRouter
from rse_pf.server.log import JsonLog
from rse_pf.server.object_refs import ObjectRefs
from rse_pf.server.scheduling.command_queue import CommandQueue
from rse_pf.server.worker_context import Clocks, WorkerContext
from rse_pf.service import Registry
from rse_pf.services import echo
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire import SUBPROTOCOLS, Codec, Hello, make_codec
from tests.kit.fakes import FakeLoop, FakeWire

BINARY = 2
UNIX_S = 1_000_000.0


class WorkerParts:
    """A dispatcher and everything around it; the Unix clock shows `UNIX_S` when the loop begins."""

    def __init__(
        self,
        log: JsonLog,
        *,
        settings: PlatformSettings | None = None,
        keys: KeySet | None = None,
        codec: str = "bin",
        register: Callable[[Registry], None] | None = None,
        store: MemoryStore | None = None,
        queues: Sequence[CommandQueue] = (),
        live_maps: Callable[[WorkerContext, Answers], LiveMapRouter] | None = None,
        processes: LimitedProcesses | None = None,
        emulated_cores: float = 0.0,
    ) -> None:
        settings = settings or PlatformSettings()
        if emulated_cores:
            settings = replace(settings, serving=replace(settings.serving, emulated_cores=emulated_cores))
        self.settings = settings
        self.loop = FakeLoop()
        self.codec: Codec = make_codec(codec)
        self.told: list[dict[str, Any]] = []
        self.cpu_s = 0.0
        began = self.loop.now
        self.clocks = Clocks(
            monotonic=lambda: self.loop.now,
            wall=lambda: UNIX_S + self.loop.now - began,
            cpu=lambda: self.cpu_s,
        )
        self.registry = Registry()
        echo.register(self.registry)
        if register is not None:
            register(self.registry)
        self.handshake = HandshakePolicy(self.settings, keys)
        self.context = WorkerContext(
            settings=self.settings,
            server_id="s-1",
            clocks=self.clocks,
            loop=self.loop,
            log=log,
            new_session_id=lambda: "session-1",
        )
        self.metrics = self.context.metrics
        self.answers = Answers(
            self.context,
            registry=self.registry,
            services=frozenset(service.name for service in self.registry),
            objects=ObjectRefs(store, self.settings.data),
        )
        self.token_watch = TokenWatch(
            self.context,
            set(),
            self.handshake,
            send=lambda **message: self.told.append(message),
            recorder=AuditRecorder(self.clocks, loop=self.loop, send=self.told.append, is_on=False),
        )
        updates = None if live_maps is None else live_maps(self.context, self.answers)
        limited = (
            None
            if processes is None
            else LimitedQueue(self.context, self.answers, LimitedServices(self.context, processes))
        )
        self.dispatcher = Dispatcher(
            self.context,
            answers=self.answers,
            token_watch=self.token_watch,
            queues=[queue for queue in (*queues, updates, limited) if queue is not None],
            updates=updates,
        )
        self.dispatcher.start()
        self.scheduler = self.dispatcher.stateless.scheduler
        self.admission = self.dispatcher.admission
        self.decoder = self.dispatcher.decoder

    def join(
        self,
        robot: str = "r",
        *,
        expires_s: float | None = None,
        hello: bool = True,
        scopes: tuple[str, ...] | None = None,
    ) -> tuple[RobotConnection, FakeWire]:
        """Connect *robot*, whose token expires at Unix time *expires_s*; None as *scopes* is no token."""
        identity = RobotId("default", robot)
        claims = None if scopes is None else Claims(
            robot=identity, token_id="t", issued_s=UNIX_S, expires_s=UNIX_S + 600.0, key_id="k", scopes=scopes
        )  # fmt: skip
        accepted = Accepted(
            robot=identity,
            claims=claims,
            codec=self.codec.name,
            subprotocol=SUBPROTOCOLS[self.codec.name],
            expires_s=expires_s,
        )
        wire = FakeWire(self.codec)
        connection = self.dispatcher.connect(wire, accepted)
        if hello:
            self.say(connection, Hello())
        return connection, wire

    def say(self, connection: RobotConnection, message: Any) -> None:
        """Let *connection* receive *message*; bytes are sent as they are."""
        data = message if isinstance(message, bytes) else self.codec.encode(message)
        connection.receive_frame(BINARY, True, False, data)


@contextmanager
def quiet_log() -> Iterator[JsonLog]:
    """Yield a log whose lines go nowhere."""
    fd = os.open(os.devnull, os.O_WRONLY)
    log = JsonLog(level="error", server="s-1", wall_clock=lambda: 0.0, fd=fd).start()
    try:
        yield log
    finally:
        log.close()
        os.close(fd)


@contextmanager
def worker_parts(**changes: Any) -> Iterator[WorkerParts]:
    """Yield a worker that is closed at the end."""
    with quiet_log() as log:
        parts = WorkerParts(log, **changes)
        try:
            yield parts
        finally:
            parts.dispatcher.close_all()
