"""Control the `zygote` from its worker: start it, order sandboxes, and receive reports of their ends.

The event loop is blocked only by `ZygoteClient.start`, until the zygote is ready, and by `ZygoteClient.close`
for up to 0.5 s.  A zygote that exits unexpectedly is replaced at once; orders that are sent to the new one
before it is ready wait in its socket.
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

SCRATCH_BYTES = 1 << 24  # size of the scratch folder of one sandbox in bytes, a part of its memory limit
_END_S = 0.5  # seconds within which a zygote must kill its sandboxes and exit; after that it is killed


class ZygoteClient:
    """The zygote of one worker.

    Attributes:
        missing: Names of `isolation.ISOLATION` that this machine lacks; empty before the zygote is ready.
    """

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
        """Prepare; `start` starts the zygote.

        Args:
            services: Services that sandboxes may load.
            settings: Limits of sandboxes, ``services.accept_weak_isolation``, and the time limit of the start
                (``local.start_timeout_s``).
            loop: Event loop of the worker.
            log: Log of the worker.
            on_gone: Called with the number of a sandbox whose process has ended, and the reason in words.
            on_lost: Called when the zygote has exited unexpectedly, and every sandbox with it; a new zygote
                is starting.
            on_ready: If given, `start` does not block.  The function is called once: with the missing means
                of isolation when the zygote is ready, or with None if it has exited before.  The caller then
                decides whether the sandboxes are used; a zygote that has exited is not replaced.
        """
        self._services = services
        self._settings = settings
        self._loop = loop
        self._log = log
        self._on_gone, self._on_lost = on_gone, on_lost
        self._handles: dict[int, int] = {}
        """Descriptor of the process (pidfd) of each sandbox, by number of the sandbox."""
        self._paused: set[int] = set()  # numbers of the sandboxes that are, or will be, stopped by SIGSTOP
        self._on_ready = on_ready
        self.missing: tuple[str, ...] = ()

    def start(self) -> None:
        """Start the zygote, and wait until it is ready unless *on_ready* was given.

        Raises:
            ConfigurationError: The zygote did not start, or a means of isolation is missing and weak
                isolation is not accepted; only without *on_ready*.
        """
        self._launch()
        if self._on_ready is None:
            self.missing = self._wait_until_ready()
        self._listen()

    def create(self, number: int, channel: socket.socket, output: int) -> bool:
        """Order the zygote to start sandbox *number*.

        Args:
            number: Number of the sandbox.
            channel: The sandbox's end of the socket for messages.
            output: Descriptor to which the sandbox prints.

        Returns:
            False if the order could not be sent, because too many orders wait or the zygote has exited.
        """
        try:
            send_order(self._process, "create", number, channel.fileno(), output)
        except OSError:
            return False
        return True

    def end(self, number: int) -> None:
        """Order the zygote to kill sandbox *number*; does nothing if the sandbox has ended already."""
        with contextlib.suppress(OSError):
            send_order(self._process, "end", number)

    def pause(self, number: int) -> None:
        """Stop all threads of sandbox *number* by SIGSTOP until `resume`.

        A sandbox whose process the zygote has not reported yet is stopped when it is reported.
        """
        self._paused.add(number)
        self._signal(number, signal.SIGSTOP)

    def resume(self, number: int) -> None:
        """Continue sandbox *number* by SIGCONT; does nothing if it is not paused."""
        if number in self._paused:
            self._paused.discard(number)
            self._signal(number, signal.SIGCONT)

    def close(self) -> None:
        """End the zygote, which kills every sandbox; waits up to 0.5 s, then kills the zygote."""
        self._loop.remove_reader(self._channel.fileno())
        self._stop()

    def retire(self) -> None:
        """End the zygote, which kills every sandbox; a thread waits for it and kills it after 0.5 s."""
        self._loop.remove_reader(self._channel.fileno())
        self._channel.close()
        self._forget_all()
        self._loop.run_in_executor(None, self._process.end, _END_S)

    def _signal(self, number: int, which: signal.Signals) -> None:
        """Send the signal *which* to the process of sandbox *number*, if that is known and has not ended.

        A pidfd is used because a process id may belong to another process by now.
        """
        if number in self._handles:
            with contextlib.suppress(ProcessLookupError):  # the process has ended; the zygote reports that
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
        # These are all environment variables of the zygote, so it gets no credentials.
        # One thread of linear algebra: a process with threads cannot be forked safely.
        # Two arenas of the allocator: each takes 64 MiB of address space, which is limited, so that with one
        # arena for each thread only 7 threads would fit.
        # Safe path: no module is imported from the folder in which the server was started, which may contain
        # files of other users.
        variables = {
            "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1",
            "MALLOC_ARENA_MAX": "2", "PYTHONSAFEPATH": "1",
        }  # fmt: skip
        plan = ChildPlan(target="rse_pf.server.sandbox.zygote:run", name="rse-pf zygote")
        self._process = start_fork_server(plan, config, environment=variables)
        self._channel = self._process.connection

    def _wait_until_ready(self) -> tuple[str, ...]:
        """Block until the zygote is ready, and return the missing means of isolation; raises as `start`."""
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
        """Handle all reports of the zygote that have arrived; replace the zygote if it has exited."""
        while True:
            try:
                report, handles = read_packet(self._channel)
            except BlockingIOError:
                return
            if report is None:
                self._loop.remove_reader(self._channel.fileno())
                self._stop()
                self._log.error("zygote-lost")
                if self._report_readiness(None):
                    return
                self._launch()
                self._listen()
                self._on_lost()
                return
            if report["event"] == "ready":
                self._log.info("sandbox-limits", cgroup=", ".join(report["cgroup"]))
                self.missing = tuple(report["missing"])
                self._report_readiness(self.missing)
            elif report["event"] == "created":
                self._on_created(report["id"], *handles)
            elif report["event"] == "gone":
                self._forget(report["id"])
                self._on_gone(report["id"], report["how"])

    def _report_readiness(self, missing: tuple[str, ...] | None) -> bool:
        """Let the event loop call *on_ready* with *missing*; return False if it is None or was called."""
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
        """Close the socket to the zygote, which then kills its sandboxes, removes their cgroups and exits.

        Waits up to 0.5 s for its exit, then kills it.
        """
        self._process.end(_END_S)
        self._forget_all()

    def _forget_all(self) -> None:
        for number in list(self._handles):
            self._forget(number)
        self._paused.clear()
