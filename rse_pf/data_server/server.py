"""Run the data service: one process with uvicorn, which announces its port when it answers requests.

Old uploads and temporary files of crashed writers are removed before the first request.  On SIGTERM and
SIGINT the process completes the requests in progress and exits, at most `_STOP_TIMEOUT_S` seconds later.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.audit.log import AuditLog
from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import REFRESH_S, TrustStore
from rse_pf.config import PlatformSettings
from rse_pf.data_server.app import DataServer
from rse_pf.data_server.uploads import UPLOAD_TTL_S
from rse_pf.errors import ConfigurationError, MissingExtra, StoreError
from rse_pf.http.connections import bounded_protocol
from rse_pf.http.unauthenticated import BACKLOG
from rse_pf.processes.event_loop import run_in_loop
from rse_pf.storage.files import replace_json
from rse_pf.storage.object_store import DirectoryStore, ObjectStore
from rse_pf.terminal import json_line, show

__all__ = ["KeysFile", "serve_data"]

_SWEEP_PERIOD_S = 3600.0  # seconds between two deletions of old uploads and temporary files
_STOP_TIMEOUT_S = 10  # seconds in which requests in progress may complete after SIGTERM or SIGINT
_MAX_IDLE_CONNECTIONS = 2048  # connections that wait for their next request; above that the oldest is closed
# Seconds for which a thread keeps the interpreter lock while others want it (`sys.setswitchinterval`): a PUT
# makes some twenty system calls, and its thread may wait for the lock after each.
_SWITCH_INTERVAL_S = 0.0005


class KeysFile:
    """The public keys in the file *path*, with roster and deny list in its folder, read again every 0.5 s."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._trust = TrustStore(path)
        self._clock = clock
        self._refreshed_s = float("-inf")

    def __call__(self) -> KeySet | None:
        """Return the keys, read again if they are older than `REFRESH_S`; None if none was ever read."""
        if self._clock() - self._refreshed_s >= REFRESH_S:
            self._refreshed_s = self._clock()
            self._trust.refresh()
        return self._trust.keys


def serve_data(
    settings: PlatformSettings,
    store: ObjectStore,
    *,
    keys: Callable[[], KeySet | None],
    announce: Path | None,
    audit: Path | None = None,
) -> int:
    """Serve requests until SIGTERM or SIGINT arrives; return the exit code 0.

    Args:
        settings: Settings of the platform; with ``data.port`` 0 a free port is chosen.
        store: Store of objects and maps.
        keys: Returns the keys that may sign tokens; called for each request.
        announce: File into which pid and port are written as JSON when the server answers requests; None
            writes no file.
        audit: Folder of the audit log; None records nothing.

    Raises:
        ConfigurationError: The server cannot listen on its address, or the audit log cannot be written.
        MissingExtra: uvicorn or uvloop is not installed.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise MissingExtra("uvicorn", "backend") from error
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    log = None if audit is None else _audit_log(audit, settings)
    app = DataServer(settings, store, keys=keys, log=_write_line, audit=log)
    keys()  # reads the keys and imports the cryptography before the first request, which is then not slow
    listening = _listen(settings)
    config = uvicorn.Config(
        app, http=bounded_protocol(most_idle=_MAX_IDLE_CONNECTIONS, ends_with_client=True), ws="none",
        lifespan="off", access_log=False, log_level="warning", backlog=BACKLOG, server_header=False,
        date_header=False, proxy_headers=False, timeout_graceful_shutdown=_STOP_TIMEOUT_S,
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT):
        # uvicorn sends the signal to its own process again when it has stopped; without a handler that
        # would kill the process, and the exit code would not be 0.
        signal.signal(number, lambda number, frame: None)
    try:
        run_in_loop(_run(uvicorn.Server(config), app, store, listening, settings, announce))
    finally:
        app.close()
        app.record_counted()
        if log is not None:
            log.close()
    return 0


def _audit_log(folder: Path, settings: PlatformSettings) -> AuditLog:
    log = AuditLog(
        folder, "data", wall_clock=time.time,
        on_problem=lambda problem: _write_line({"event": "audit-failed", "error": problem}),
    ).open()  # fmt: skip
    log.start()
    return log


async def _run(
    server: Any, app: DataServer, store: ObjectStore, listening: socket.socket, settings: PlatformSettings,
    announce: Path | None,
) -> None:  # fmt: skip
    port = listening.getsockname()[1]
    await asyncio.to_thread(_sweep, app, store)
    sweeping = asyncio.create_task(_sweep_periodically(app, store))
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    try:
        while not server.started and not serving.done():
            await asyncio.sleep(0.005)
        if announce is not None and server.started:
            replace_json(announce, {"pid": os.getpid(), "port": port})
        _write_line({"event": "ready", "port": port, "store": settings.data.store})
        await serving
    finally:
        sweeping.cancel()


async def _sweep_periodically(app: DataServer, store: ObjectStore) -> None:
    while True:
        await asyncio.sleep(_SWEEP_PERIOD_S)
        await asyncio.to_thread(_sweep, app, store)


def _sweep(app: DataServer, store: ObjectStore) -> None:
    try:
        uploads = app.handlers.objects.sweep()
        files = 0
        if isinstance(store, DirectoryStore):
            files = store.sweep(now=time.time(), older_than_s=UPLOAD_TTL_S)
    except StoreError as error:
        _write_line({"event": "sweep-failed", "error": error.message})
        return
    if uploads or files:
        _write_line({"event": "swept", "uploads": uploads, "files": files})


def _listen(settings: PlatformSettings) -> socket.socket:
    host, port = settings.data.host, settings.data.port
    try:
        listening = socket.create_server(
            (host, port), backlog=BACKLOG, family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
        # asyncio sets TCP_NODELAY only on sockets that name their protocol.  A reply is sent as a head and a
        # body; without the option the body waits 40 ms for the delayed acknowledgement of the head.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listening
    except OSError as error:
        raise ConfigurationError(
            f"cannot listen on {host}:{port}: {error.strerror}", hint="choose another data.port"
        ) from error


def _write_line(fields: dict[str, Any]) -> None:
    show(json_line({"time": round(time.time(), 3), **fields}, msgspec.json.encode).decode(), error=True)
