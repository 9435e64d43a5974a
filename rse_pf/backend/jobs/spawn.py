"""Start the process of one job (`job_process`) and hand it its order.

Promises that the process gets no credentials but the store's, and one thread for linear algebra: the same
inputs give the same result.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from rse_pf.backend.jobs.runner import JobRequest
from rse_pf.backend.sandbox.ipc import encode_message
from rse_pf.config import PlatformSettings
from rse_pf.linux import run_when_idle

__all__ = ["JobProcess", "spawner"]

_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class JobProcess:
    """A started process and the socket to it."""

    def __init__(self, order: dict[str, Any]) -> None:
        self.connection, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.backend.jobs.process", str(theirs.fileno())],
                pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, env={**os.environ, **_ONE_THREAD},
            )  # fmt: skip
        run_when_idle(self._process.pid)
        try:
            self.connection.sendall(encode_message(order))
        except OSError:
            return  # it died at once, and reading says so

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def kill(self) -> None:
        """End it, whatever it does, and reap it."""
        self._process.kill()
        self._process.wait()
        self.connection.close()

    def wait(self) -> int:
        """Return how it ended, once it did; negative for a signal."""
        return self._process.wait()


def spawner(services: str, settings: PlatformSettings) -> Callable[[JobRequest], JobProcess]:
    """Return what starts a process for a job of the registry *services* (``module:function``)."""
    plain = settings.to_dict()

    def start(wanted: JobRequest) -> JobProcess:
        return JobProcess(
            {
                "worker": os.getpid(), "services": services, "settings": plain,
                "memory_bytes": settings.serving.max_job_memory_bytes, "service": wanted.service,
                "payload": wanted.payload, "tenant": wanted.tenant, "robot": wanted.robot,
                "quota_bytes": wanted.quota_bytes, "inline_bytes": settings.session.max_message_bytes // 2,
            }
        )  # fmt: skip

    return start
