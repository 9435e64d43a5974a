"""Run the data service: one process, uvicorn, a socket that is announced when all is ready.

Promises to sweep up what a crash left behind before the first request, and to leave on SIGTERM and SIGINT
with what it is doing done, at most `_STOP_TIMEOUT_S` seconds later.
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
from rse_pf.auth.trust_store import TrustStore
from rse_pf.config import PlatformSettings
from rse_pf.data_server.app import DataServer
from rse_pf.errors import ConfigurationError, MissingExtra, StoreError
from rse_pf.files import replace_json
from rse_pf.object_store import DirectoryStore, ObjectStore

__all__ = ["KeysFile", "serve_data"]

_SWEEP_S = 3600.0
_BACKLOG = 1024
_STOP_TIMEOUT_S = 10


class KeysFile:
    """The public keys in a file and the control room beside it, read again and again; see `TrustStore`."""

    def __init__(self, path: Path, pause_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._trust = TrustStore(path)
        self._pause_s = pause_s
        self._clock = clock
        self._looked = float("-inf")

    def __call__(self) -> KeySet | None:
        """Return the keys; None while there are none."""
        if self._clock() - self._looked >= self._pause_s:
            self._looked = self._clock()
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
    """Serve until a signal comes; return the exit code.

    Args:
        settings: Groups data, auth; ``data.port`` 0 takes a free one.
        store: Where objects and maps live.
        keys: Who may sign tokens, asked for each request.
        announce: Gets pid and port as JSON, by rename, when requests are answered.
        audit: Folder of the audit log; None records nothing.

    Raises:
        ConfigurationError: The address is taken, or the audit log cannot be written.
        MissingExtra: uvicorn is not installed.
    """
    try:
        import uvicorn

        from rse_pf.data_server.one_request import OneRequestProtocol
    except ImportError as error:
        raise MissingExtra("uvicorn", "data") from error
    log = None if audit is None else _audit_log(audit, settings)
    app = DataServer(settings, store, keys=keys, log=_write_line, audit=log)
    listening = _listen(settings)
    config = uvicorn.Config(
        app, http=OneRequestProtocol, ws="none", lifespan="off", access_log=False, log_level="warning",
        backlog=_BACKLOG, server_header=False, date_header=False, proxy_headers=False,
        timeout_keep_alive=30, timeout_graceful_shutdown=_STOP_TIMEOUT_S,
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _stay)  # uvicorn sends itself the signal again when it is done
    try:
        asyncio.run(_run(uvicorn.Server(config), app, store, listening, settings, announce))
    finally:
        app.record_counted()
        if log is not None:
            log.close()
    return 0


def _audit_log(folder: Path, settings: PlatformSettings) -> AuditLog:
    log = AuditLog(
        folder, "data", wall_clock=time.time, on_problem=_say_problem,
    ).open()  # fmt: skip
    log.start()
    return log


def _say_problem(problem: str) -> None:
    _write_line({"event": "audit", "error": problem})


def _stay(number: int, frame: object) -> None:
    """Let the process end by itself, with exit code 0."""


async def _run(
    server: Any, app: DataServer, store: ObjectStore, listening: socket.socket, settings: PlatformSettings,
    announce: Path | None,
) -> None:  # fmt: skip
    await asyncio.to_thread(_sweep, app, store, settings.data.upload_ttl_s)
    sweeping = asyncio.create_task(_sweep_on(app, store, settings.data.upload_ttl_s))
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    try:
        while not server.started and not serving.done():
            await asyncio.sleep(0.005)
        if announce is not None and server.started:
            _announce(announce, listening.getsockname()[1])
        _write_line({"event": "ready", "port": listening.getsockname()[1], "store": settings.data.store})
        await serving
    finally:
        sweeping.cancel()


async def _sweep_on(app: DataServer, store: ObjectStore, life_s: float) -> None:
    while True:
        await asyncio.sleep(_SWEEP_S)
        await asyncio.to_thread(_sweep, app, store, life_s)


def _sweep(app: DataServer, store: ObjectStore, life_s: float) -> None:
    try:
        uploads = app.handlers.objects.sweep()
        files = store.sweep(now=time.time(), older_than_s=life_s) if isinstance(store, DirectoryStore) else 0
    except StoreError as error:
        _write_line({"event": "sweep-failed", "error": str(error)})
        return
    if uploads or files:
        _write_line({"event": "swept", "uploads": uploads, "files": files})


def _listen(settings: PlatformSettings) -> socket.socket:
    host, port = settings.data.host, settings.data.port
    try:
        return socket.create_server(
            (host, port), backlog=_BACKLOG, family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    except OSError as error:
        raise ConfigurationError(
            f"cannot listen on {host}:{port}: {error.strerror}", hint="choose another data.port"
        ) from error


def _announce(path: Path, port: int) -> None:
    replace_json(path, {"pid": os.getpid(), "port": port})


def _write_line(fields: dict[str, Any]) -> None:
    sys.stderr.write(msgspec.json.encode({"t": round(time.time(), 3), **fields}).decode() + "\n")
