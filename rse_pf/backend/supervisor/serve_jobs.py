"""The process of a job server: its loop, its control port, its signals.

While no job waits, its slots work for batches that invite workers (`rse_pf.batch`).
"""

from __future__ import annotations

import asyncio
import os
import secrets
import signal
import time
from pathlib import Path

from rse_pf.auth.control_token import carries_token
from rse_pf.aws.storage import open_data_store
from rse_pf.backend.jobs.job_server import JobServer
from rse_pf.backend.jobs.process import spawner
from rse_pf.backend.jobs.queue import JobQueue
from rse_pf.backend.jobs.runner import JobContext
from rse_pf.backend.jobs.slots import JobSlots, make_pipe
from rse_pf.backend.log import JsonLog
from rse_pf.backend.supervisor.listener import open_control
from rse_pf.backend.supervisor.worker_handle import BUILTIN
from rse_pf.batch.helpers import BatchHelpers
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import ServerPlacement, batch_ports
from rse_pf.control_http import ControlReply, ControlRequest, json_reply
from rse_pf.errors import RsePfError, UsageError
from rse_pf.files import replace_json

__all__ = ["serve_jobs"]

_JOBS_AT_ONCE = 1
"""Long jobs that run at the same time on one job server."""


def serve_jobs(
    settings: PlatformSettings,
    *,
    placement: ServerPlacement,
    server_id: str,
    announce: Path | None = None,
    control_token: str | None = None,
    services: str = BUILTIN,
) -> int:
    """Run jobs until a drain or a signal ends it; return 0.

    Args:
        settings: What all servers of the platform share.
        placement: Address of the control port, and the store.
        server_id: Name of this server in records and log lines.
        announce: File for pid and port, as JSON; written once jobs are taken.
        control_token: Token that the control port requires for all but its two health pages; None: no token.
        services: ``module:function`` that makes the registry of a job's process.

    Raises:
        UsageError: The store belongs to one process.
        ConfigurationError: The port is taken.
    """
    settings = placement.apply(settings)
    if settings.data.store == "memory:":
        raise UsageError(
            "a store in memory holds no jobs of other servers", hint="name --store dir:PATH or s3:BUCKET"
        )
    return asyncio.run(_Service(settings, server_id, announce, control_token, services).run())


class _Service:
    """The job server with its control port, signals and log."""

    def __init__(
        self,
        settings: PlatformSettings,
        server_id: str,
        announce: Path | None,
        control_token: str | None,
        services: str,
    ) -> None:
        self._settings = settings
        self._server_id = server_id
        self._announce = announce
        self._token = control_token
        self._log = JsonLog(level=settings.serving.log_level, server=server_id, wall_clock=time.time)
        store = open_data_store(settings)
        self._queue = JobQueue(
            store, settings, lambda name: self._log.warning("job-offer-damaged", offer=name, hint="delete it")
        )
        context = JobContext(
            store=store, slots=JobSlots(make_pipe(_JOBS_AT_ONCE)), settings=settings, server_id=server_id,
            start=spawner(services, settings), clock=time.monotonic,
            finished=self._queue.withdraw, follows=False,  # without `queue`: it offers nothing itself
        )  # fmt: skip
        self._jobs = JobServer(
            context, self._queue, self._log, lambda: f"{server_id}-{secrets.token_hex(8)}", _JOBS_AT_ONCE
        )  # fmt: skip
        _, *ports = batch_ports(settings.batch)
        self._helpers = BatchHelpers(store, _JOBS_AT_ONCE, ports=f"{ports[0]}:{ports[-1]}")
        self._waiting = 0
        self._state = "starting"
        self._over = asyncio.Event()

    async def run(self) -> int:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._over.set)
        control = await open_control(self._settings.serving, self._answer)
        port = control.sockets[0].getsockname()[1]
        try:
            self._state = "ready"
            address = {"server": self._server_id, "pid": os.getpid(), "control_port": port}
            if self._announce is not None:
                replace_json(self._announce, address)
            self._log.info("job-server-ready", **address, settings=self._settings.digest())
            while not self._over.is_set():
                await asyncio.to_thread(self._step)
                try:
                    await asyncio.wait_for(self._over.wait(), self._settings.serving.job_poll_s)
                except (asyncio.TimeoutError, TimeoutError):
                    continue
        finally:
            self._state = "draining"
            control.close()
            await asyncio.to_thread(self._leave)
            if self._announce is not None:
                self._announce.unlink(missing_ok=True)
            self._log.info("job-server-over")
            self._log.close()
        return 0

    def _step(self) -> None:
        try:
            self._jobs.step()
            self._waiting = self._queue.waiting()
            self._helpers.step(may_help=self._jobs.running == 0)
        except RsePfError as error:
            self._log.warning("job-queue", reason=error.message)

    def _leave(self) -> None:
        self._jobs.leave()
        self._helpers.close()

    async def _answer(self, ask: ControlRequest) -> ControlReply:
        page = (ask.method, ask.path)
        if page == ("GET", "/healthz"):
            return json_reply({"server": self._server_id, "settings": self._settings.digest()})
        if page == ("GET", "/readyz"):
            return json_reply({"state": self._state}, status=200 if self._state == "ready" else 503)
        if self._token is not None and not carries_token(ask.authorization, self._token):
            return json_reply({"code": "unauthorized"}, status=401)
        if page == ("GET", "/metrics"):
            # A batch that works here is a job, too; the servers of the robots count the jobs that wait.
            jobs = self._jobs.running + bool(self._helpers.pids)
            lines = f"rse_pf_jobs {jobs}\nrse_pf_jobs_pending 0\nrse_pf_job_offers {self._waiting}\n"
            return ControlReply(body=lines.encode(), content_type="text/plain; version=0.0.4")
        if page == ("POST", "/drain"):
            self._over.set()
            return json_reply({"state": "draining"})
        return json_reply({"code": "not-found"}, status=404)
