"""The recording of one server: pipes from its workers to a recorder process, which ends with the last one.

A server serves robots whether it can record or not.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.recording.recorder_process import RecorderPlan, start_recorder
from rse_pf.recording.tap import recording_pipe
from rse_pf.wire import PROTOCOL_VERSION

__all__ = ["ServerRecording", "server_version"]

_FINISH_S = 3.0
"""Time that the recorder has to finish its file when the workers are gone."""


def server_version() -> str:
    """Return the version of the installed platform, "unknown" in a plain checkout."""
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "unknown"


class ServerRecording:
    """The pipes and the recorder of one server; both are there inside of ``with``, before workers are forked.

    ``ends`` are the workers' ends of the pipes, None for each where nothing is recorded; ``pids`` has the
    process of the recorder.
    """

    def __init__(
        self, settings: PlatformSettings, server: str, workers: int, key: Path | None = None
    ) -> None:
        """Start nothing yet; *key* is the file of the key of pseudonyms, None for a key of its own."""
        self._key = "" if key is None else str(key)
        self.ends: list[int | None] = [None] * workers
        self.pids: list[int] = []
        self._settings = settings
        self._server = server
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> ServerRecording:
        """Start the recorder, if ``recording.folder`` is set."""
        recording = self._settings.recording
        if not recording.folder:
            return self
        pipes = [recording_pipe() for _ in self.ends]
        plan = RecorderPlan(
            folder=recording.folder, server=self._server, version=server_version(), started_ns=time.time_ns(),
            fds=[ours for ours, _ in pipes], max_file_bytes=recording.max_file_bytes,
            max_bytes=recording.max_bytes, session=asdict(self._settings.session), key=self._key,
            metadata={
                "side": "server", "protocol": str(PROTOCOL_VERSION), "engine": self._settings.pnp.engine,
                "pnp": json.dumps(asdict(self._settings.pnp)),
            },
        )  # fmt: skip
        self._process = start_recorder(plan)
        self.pids = [self._process.pid]
        self.ends = [theirs for _, theirs in pipes]
        for ours, _ in pipes:
            os.close(ours)
        return self

    def handed_over(self) -> None:
        """Close the workers' ends in this process, so that the recorder sees the end of the workers."""
        for fd in self.ends:
            if fd is not None:
                os.close(fd)
        self.ends = [None] * len(self.ends)

    def __exit__(self, *_: object) -> None:
        """Wait until the recorder has finished its file; all workers are gone."""
        self.handed_over()
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_FINISH_S)
