"""Control the `zygote` from its worker: start it, order sandboxes, and get reports of their ends.

Only the first start blocks; orders to a zygote that is restarted wait in its channel.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import tempfile
from asyncio import AbstractEventLoop
from collections.abc import Callable, Sequence

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.processes.fork_server import read_packet, send_order, start_fork_server
from rse_pf.processes.start import ChildPlan
from rse_pf.server.worker_context import Log
from rse_pf.services.custom.installed import InstalledService

__all__ = ["ZygoteClient"]

SCRATCH_BYTES = 1 << 24  # scratch folder of one sandbox, in its memory; it has one inode for 4,096 bytes
_END_S = 0.5  # a zygote has this long to end its sandboxes before it is killed


class ZygoteClient:
    """The zygote of one worker; ``missing`` names the means of isolation that this machine lacks."""

    def __init__(
        self,
        services: Sequence[InstalledService],
        settings: PlatformSettings,
        *,
        loop: AbstractEventLoop,
        log: Log,
        on_gone: Callable[[int, str], None],
        on_lost: Callable[[], None],
        on_ready: Callable[[tuple[str, ...] | None], None] | None = None,
    ) -> None:
        """Describe the zygote; `start` starts it.

        Args:
            services: Services that sandboxes may load.
            settings: Limits of sandboxes.
            loop: Event loop of the worker.
            log: Log of the worker.
            on_gone: Called with the number of a sandbox that ended, and how it ended.
            on_lost: Called when the zygote ended, and every sandbox with it; a new one is starting.
            on_ready: If given, `start` does not block: it is called once, with the means of isolation that
                are missing, or with None if the zygote ended before.  The caller decides whether to go on.
        """
        self._services = services
        self._settings = settings
        self._loop = loop
        self._log = log
        self._on_gone, self._on_lost = on_gone, on_lost
        self._handles: dict[int, int] = {}
        """Descriptors of the processes of sandboxes, by number."""
        self._paused: set[int] = set()
        self._on_ready = on_ready
        self.missing: tuple[str, ...] = ()

    def start(self) -> None:
        """Start the zygote, and wait until it is ready unless *on_ready* was given.

        Raises:
            ConfigurationError: It did not start, or a means of isolation is missing and weak isolation
                was not accepted.
        """
        self._launch()
        if self._on_ready is None:
            self.missing = self._wait_until_ready()
        self._listen()

    def create(self, number: int, channel: socket.socket, output: int) -> bool:
        """Order sandbox *number* with its descriptors; return False if too many orders wait."""
        try:
            send_order(self._process, "create", number, channel.fileno(), output)
        except OSError:
            return False
        return True

    def end(self, number: int) -> None:
        """Order that sandbox *number* is killed; it is no error if it has ended already."""
        with contextlib.suppress(OSError):
            send_order(self._process, "end", number)

    def pause(self, number: int) -> None:
        """Stop every thread of sandbox *number* until `resume`; it may still be starting."""
        self._paused.add(number)
        self._signal(number, signal.SIGSTOP)

    def resume(self, number: int) -> None:
        """Resume sandbox *number*; one that is not paused is no error."""
        if number in self._paused:
            self._paused.discard(number)
            self._signal(number, signal.SIGCONT)

    def close(self) -> None:
        """End the zygote, and with it every sandbox."""
        self._loop.remove_reader(self._channel.fileno())
        self._stop()

    def retire(self) -> None:
        """End the zygote and every sandbox without waiting for it."""
        self._loop.remove_reader(self._channel.fileno())
        self._channel.close()
        self._forget_all()
        self._loop.run_in_executor(None, self._process.end, _END_S)

    def _signal(self, number: int, which: signal.Signals) -> None:
        """Send a signal; a descriptor never means another process, as a reused process id could."""
        if number in self._handles:
            with contextlib.suppress(ProcessLookupError):  # it has ended, which the zygote reports
                signal.pidfd_send_signal(self._handles[number], which)

    def _launch(self) -> None:
        limits = self._settings.services
        config = {
            "temporary": tempfile.gettempdir(),
            "services": [
                {
                    "name": s.name, "language": s.language, "entry": s.entry, "kind": s.kind,
                    "folder": str(s.folder), "dependencies": s.dependencies and str(s.dependencies),
                    "identity": s.identity,
                }
                for s in self._services
            ],
            "memory_bytes": limits.memory_bytes, "scratch_bytes": SCRATCH_BYTES,
            "total_bytes": limits.memory_bytes,
            "max_bytes": self._settings.session.max_inflated_bytes,
        }  # fmt: skip
        # No credentials, and no threads of the linear algebra library: it will be forked.  Each arena of the
        # allocator takes 64 MiB of address space, which is limited; with one for each thread, 7 threads fit.
        # Nothing is imported from the folder in which the server was started: it may contain a service of
        # somebody else.
        variables = {
            "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1",
            "MALLOC_ARENA_MAX": "2", "PYTHONSAFEPATH": "1",
        }  # fmt: skip
        plan = ChildPlan(target="rse_pf.server.sandbox.zygote:run", name="rse-pf zygote")
        self._process = start_fork_server(plan, config, environment=variables)
        self._channel = self._process.connection

    def _wait_until_ready(self) -> tuple[str, ...]:
        self._channel.settimeout(self._settings.local.start_timeout_s)
        try:
            report, _ = read_packet(self._channel)
        except TimeoutError:
            report = None
        missing = () if report is None else tuple(report["missing"])
        if report is None:
            self._stop()
            raise ConfigurationError("the zygote of sandboxes did not start", hint="see the server's log")
        if missing and not self._settings.services.accept_weak_isolation:
            self._stop()
            raise ConfigurationError(
                f"installed services need isolation that this machine lacks: {', '.join(missing)}",
                hint="allow unprivileged user namespaces and seccomp, or start with --accept-weak-isolation",
            )
        if missing:
            self._log.warning("weak-isolation", missing=", ".join(missing))
        self._log.info("sandbox-limits", cgroup=", ".join(report["cgroup"]))
        return missing

    def _listen(self) -> None:
        self._channel.setblocking(False)
        self._loop.add_reader(self._channel.fileno(), self._read_reports)

    def _read_reports(self) -> None:
        while True:
            try:
                report, handles = read_packet(self._channel)
            except BlockingIOError:
                return
            if report is None:
                self._loop.remove_reader(self._channel.fileno())
                self._stop()
                self._log.error("zygote-lost")
                if self._tell_ready(None):
                    return
                self._launch()
                self._listen()
                self._on_lost()
                return
            if report["event"] == "ready":
                self._log.info("sandbox-limits", cgroup=", ".join(report["cgroup"]))
                self.missing = tuple(report["missing"])
                self._tell_ready(self.missing)
            elif report["event"] == "created":
                self._on_created(report["id"], *handles)
            elif report["event"] == "gone":
                self._forget(report["id"])
                self._on_gone(report["id"], report["how"])

    def _tell_ready(self, missing: tuple[str, ...] | None) -> bool:
        """Call `on_ready` once, outside of this call; return whether there was one."""
        on_ready, self._on_ready = self._on_ready, None
        if on_ready is not None:
            self._loop.call_soon(on_ready, missing)
        return on_ready is not None

    def _on_created(self, number: int, handle: int) -> None:
        self._handles[number] = handle
        if number in self._paused:
            self._signal(number, signal.SIGSTOP)

    def _forget(self, number: int) -> None:
        self._paused.discard(number)
        if number in self._handles:
            os.close(self._handles.pop(number))

    def _stop(self) -> None:
        """End the zygote: it ends its sandboxes and removes their cgroups when the channel is closed."""
        self._process.end(_END_S)
        self._forget_all()

    def _forget_all(self) -> None:
        for number in list(self._handles):
            self._forget(number)
        self._paused.clear()
