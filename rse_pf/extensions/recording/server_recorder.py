"""Start the recorder process of a server, restart it after a crash, and connect workers to it.

The recorder exits after the last worker.  A server that cannot record serves robots all the same.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.extensions.recording.recorder_process import RecorderPlan, start_recorder
from rse_pf.extensions.recording.redact import KEY_BYTES
from rse_pf.extensions.recording.tap import RecordingTap, send_pipe
from rse_pf.processes.start import Child
from rse_pf.server.worker_context import Log, MessageTap, NullMessageTap
from rse_pf.version import installed_version
from rse_pf.wire import PROTOCOL_VERSION

__all__ = ["FileServerRecorder"]

_FINISH_TIMEOUT_S = 3.0
"""Longest time, seconds, that a server waits for the recorder to finish its file after the last worker."""
_MAX_RESTARTS = 5  # restarts of a recorder within `_RESTART_WINDOW_S` after which recording is given up
_RESTART_WINDOW_S = 600.0  # time, seconds, in which restarts of a recorder are counted


class FileServerRecorder:
    """Record one server in files within ``with``; implements `rse_pf.server.worker_context.ServerRecorder`.

    A recorder process that exits while there are workers is restarted, up to five times in ten minutes.
    Workers send the recorder the other ends of their pipes over the socket ``to_recorder``; ``pids`` holds
    the id of the recorder process, or nothing once recording was given up.
    """

    def __init__(
        self,
        settings: PlatformSettings,
        server: str,
        key: Path | None = None,
        *,
        start: Callable[[RecorderPlan, bytes], Child] = start_recorder,
        restart_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare to record; ``with`` starts the recorder.

        Args:
            settings: Settings of the server, with ``recording.folder``.
            server: Name of the server.
            key: File with the key of the pseudonyms; None for a random key.
            start: Starts a recorder process with a plan and a key.
            restart_s: Delay of the first restart, seconds; each further one in ten minutes doubles it.
            clock: Monotonic clock, seconds.
        """
        self._key = "" if key is None else str(key)
        self.to_recorder: int | None = None
        self.pids: list[int] = []
        self._settings = settings
        self._server = server
        self._start, self._restart_s, self._clock = start, restart_s, clock
        self._random_key = secrets.token_bytes(KEY_BYTES)
        self._from_workers: socket.socket | None = None
        self._to_recorder: socket.socket | None = None
        self._process: Child | None = None
        self._watching: threading.Thread | None = None
        self._is_over = threading.Event()

    def __enter__(self) -> FileServerRecorder:
        """Start the recorder process, and prepare the thread that restarts it; the thread starts later."""
        recording = self._settings.recording
        self._from_workers, self._to_recorder = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._to_recorder.setblocking(False)
        self.to_recorder = self._to_recorder.fileno()
        plan = RecorderPlan(
            folder=recording.folder, server=self._server, version=installed_version(),
            started_ns=time.time_ns(), from_workers=self._from_workers.fileno(),
            max_bytes=recording.max_bytes, session=asdict(self._settings.session), key=self._key,
            metadata={
                "side": "server", "protocol": str(PROTOCOL_VERSION), "engine": self._settings.pnp.engine,
                "pnp": json.dumps(asdict(self._settings.pnp)),
            },
        )  # fmt: skip
        self._process = self._start(plan, self._random_key)
        self.pids = [self._process.pid]
        self._watching = threading.Thread(
            target=self._watch, args=(plan, self._process), name="recorder", daemon=True
        )
        return self

    def open_tap(self, call_later: Callable[[float, Callable[[], None]], object], log: Log) -> MessageTap:
        """Return the tap of a worker that is connected to the recorder; called in the worker after the fork.

        Without a recorder, the tap records nothing.
        """
        to_recorder = self.to_recorder
        pipe = None if to_recorder is None else send_pipe(to_recorder)
        if to_recorder is None or pipe is None:
            return NullMessageTap()

        def renew() -> int | None:
            log.error("recorder-lost", hint="a new recorder is started; if none starts, restart the server")
            return send_pipe(to_recorder)

        return RecordingTap(
            pipe,
            call_later=call_later,
            on_dead=lambda: log.error("recording-over", hint="restart the server to record again"),
            renew=renew,
        )

    def leave_to_workers(self) -> None:
        """Close this process's end of the socket, and start the thread that restarts the recorder.

        The recorder notices the exit of the last worker only if this process does not hold the socket.  No
        worker may be forked afterwards, since the process then has a thread.
        """
        if self._to_recorder is not None:
            self._to_recorder.close()
            self._to_recorder = self.to_recorder = None
        if self._watching is not None and self._watching.ident is None and not self._is_over.is_set():
            self._watching.start()

    def __exit__(self, *_: object) -> None:
        """Wait up to 3 s until the recorder has finished its file; all workers have exited before."""
        if self._watching is None:
            return
        self.leave_to_workers()
        self._is_over.set()
        self._watching.join(_FINISH_TIMEOUT_S)
        if self._from_workers is not None:
            self._from_workers.close()

    def _watch(self, plan: RecorderPlan, process: Child) -> None:
        """Restart the recorder until it exits with 0, this server stops, or it has failed too often.

        *process* is the first recorder.  When recording is given up, the socket is closed, so that workers
        notice that there will be no recorder.
        """
        ends: deque[float] = deque()
        while process.wait() != 0 and not self._is_over.is_set():  # it exits with 0 after the last worker
            now = self._clock()
            ends.append(now)
            while ends[0] < now - _RESTART_WINDOW_S:
                ends.popleft()
            if len(ends) > _MAX_RESTARTS:
                _log(self._server, "recorder-given-up", "restart the server to record again", len(ends))
                break
            if self._is_over.wait(self._restart_s * 2 ** (len(ends) - 1)):
                return
            try:
                plan = msgspec.structs.replace(plan, restarts=plan.restarts + 1)
                process = self._start(plan, self._random_key)
            except OSError as error:
                _log(self._server, "recorder-given-up", str(error), len(ends))
                break
            self.pids[:] = [process.pid]
            _log(self._server, "recorder-restarted", "look for the error of the recorder above", len(ends))
        else:
            return
        self.pids.clear()
        if self._from_workers is not None:
            self._from_workers.close()  # workers notice by it that there will be no recorder


def _log(server: str, event: str, hint: str, ends: int) -> None:
    """Write a log line of level error in the format of the server; *ends* is the number of recent exits."""
    line = {
        "time": time.time(),
        "level": "error",
        "event": event,
        "server": server,
        "ends": ends,
        "hint": hint,
    }
    with suppress(OSError):
        os.write(2, json.dumps(line).encode() + b"\n")
