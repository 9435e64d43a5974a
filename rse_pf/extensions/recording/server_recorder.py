"""Record one server: start the recorder process, which exits after the last worker, and restart it.

A server serves robots whether it can record or not.
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
from rse_pf.extensions.recording.tap import RecordingTap, hand_pipe
from rse_pf.processes.start import Child
from rse_pf.server.worker_context import Log, MessageTap, NullMessageTap
from rse_pf.version import installed_version
from rse_pf.wire import PROTOCOL_VERSION

__all__ = ["FileServerRecorder"]

_FINISH_S = 3.0
"""Time that the recorder has to finish its file when the workers are gone."""
_MOST_RESTARTS, _WITHIN_S = 5, 600.0


class FileServerRecorder:
    """Record one server in files, inside of ``with``; a `rse_pf.server.worker_context.ServerRecorder`.

    A recorder process that exits although there are workers is started again, up to five times in ten
    minutes.  Workers send it the ends of their pipes by the socket ``to_recorder``.
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
        """Start nothing yet.

        Args:
            settings: Of the server; ``recording.folder`` is set.
            server: Its name.
            key: File of the key of pseudonyms, None for a key of its own.
            start: Starts a recorder with its key.
            restart_s: Delay of the first restart; each one doubles it.
            clock: Seconds of restarts.
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
        """Start the recorder process."""
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
        """Return the tap of a worker, connected to the recorder; the worker was forked from this process."""
        to_recorder = self.to_recorder
        pipe = None if to_recorder is None else hand_pipe(to_recorder)
        if to_recorder is None or pipe is None:
            return NullMessageTap()

        def renew() -> int | None:
            log.error("recorder-lost", hint="a new one is started; restart the server if none is")
            return hand_pipe(to_recorder)

        return RecordingTap(
            pipe,
            call_later=call_later,
            on_dead=lambda: log.error("recording-over", hint="restart the server to record again"),
            renew=renew,
        )

    def leave_to_workers(self) -> None:
        """Leave the socket to the workers, so that the recorder sees their end, and watch the recorder.

        Nothing may be forked afterwards: there is a thread.
        """
        if self._to_recorder is not None:
            self._to_recorder.close()
            self._to_recorder = self.to_recorder = None
        if self._watching is not None and self._watching.ident is None and not self._is_over.is_set():
            self._watching.start()

    def __exit__(self, *_: object) -> None:
        """Wait until the recorder has finished its file; all workers are gone."""
        if self._watching is None:
            return
        self.leave_to_workers()
        self._is_over.set()
        self._watching.join(_FINISH_S)
        if self._from_workers is not None:
            self._from_workers.close()

    def _watch(self, plan: RecorderPlan, process: Child) -> None:
        """Start the recorder again until the workers or this server end; *process* is the first one."""
        ends: deque[float] = deque()
        while process.wait() != 0 and not self._is_over.is_set():  # with 0 the workers are gone
            now = self._clock()
            ends.append(now)
            while ends[0] < now - _WITHIN_S:
                ends.popleft()
            if len(ends) > _MOST_RESTARTS:
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
            _log(self._server, "recorder-restarted", "see why it ended", len(ends))
        else:
            return
        self.pids.clear()
        if self._from_workers is not None:
            self._from_workers.close()  # so that workers see that there will be no recorder


def _log(server: str, event: str, hint: str, ends: int) -> None:
    """Write a log line, as the server writes its own."""
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
