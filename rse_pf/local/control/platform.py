"""The whole platform on one machine: a real load balancer in front of real backend servers.

``async with LocalPlatform(settings, state=folder) as platform`` starts everything that a demo, an experiment
or a test needs.  No process that it started runs on after the block, however the block is left; only those of
an adoptable platform whose control plane was killed with SIGKILL do.  The platform starts, drains and
replaces servers by itself only if it is elastic.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import os
import secrets
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.auth.control_token import ensure_control_token
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.balancer.envoy_config import DATA_CLUSTER, ROSBRIDGE_CLUSTER
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.local.control.audit_recorder import PlatformAudit
from rse_pf.local.control.control_plane import ControlOptions, ControlPlane
from rse_pf.local.control.federation import service_discovery
from rse_pf.local.control.fleet import Fleet, FleetReports, Member
from rse_pf.local.control.operator_port import OperatorPort
from rse_pf.local.control.platform_recorder import NullPlatformRecorder, PlatformRecorder
from rse_pf.local.control.scale_modifier import bounds_for
from rse_pf.local.control.settings_change import SettingsChange, settings_change
from rse_pf.local.disk_watch import DiskWatch
from rse_pf.local.firewall import check_lan_settings, check_listener, ensure_key, key_file, robots_url
from rse_pf.local.lan.listener import LanListener, authority_file
from rse_pf.local.processes import (
    STOP_TIMEOUT_S,
    ended,
    is_alive,
    mark_of,
    reap_orphans,
    rotate_logs,
    send_signal,
)
from rse_pf.local.servers.backend_servers import (
    RSE_PF,
    BackendServer,
    LocalBackendServers,
    local_placement,
)
from rse_pf.local.servers.single_servers import local_data_server, local_rosbridge_server
from rse_pf.local.servers.watched_server import WatchedServer
from rse_pf.local.state import (
    PlatformLock,
    PlatformState,
    ServerState,
    control_token_file,
    read_state,
    remove_state,
    settings_file,
    state_file,
)
from rse_pf.local.together import run_together
from rse_pf.storage.files import replace_json

__all__ = ["LocalPlatform"]

Event = Mapping[str, Any]

_LOOPBACK = "127.0.0.1"
# Time limit of reading the /status page of a server that is adopted, in seconds.
_STATUS_TIMEOUT_S = 1.0
# Number of the newest events that the status document holds.
_LAST_EVENTS = 50
# Name of the file for ``file_sd_configs`` of Prometheus, in the state folder.
_TARGETS_FILE = "prometheus_sd.json"
# Size in bytes above which a log is rotated; one rotated log of each process is kept.
_LOG_FILE_BYTES = 64 << 20


class LocalPlatform:
    """A local platform: entering the context starts its processes, leaving it stops them.

    ``url`` is the address that robots connect to, "" before the start; ``events`` all events so far.
    """

    def __init__(
        self,
        settings: PlatformSettings,
        *,
        state: Path,
        servers: int | None = None,
        port: int | None = None,
        name: str | None = None,
        data: bool = False,
        adoptable: bool = False,
        control: ControlOptions | None = None,
        on_event: Callable[[Event], None] | None = None,
        program: Sequence[str] = RSE_PF,
        lan: str = "",
        metrics_port: int = 0,
        recorder: PlatformRecorder | None = None,
    ) -> None:
        """Describe a platform; nothing is started.

        Args:
            settings: Settings of the load balancer, the control plane and every server.
            state: Folder of keys, logs and ``platform.json``; created with mode 0700.
            servers: Number of backend servers at the start; None means ``local.servers``.  A number below
                ``scaling.min_servers`` or above ``scaling.max_servers`` replaces that bound.
            port: Port that robots connect to, 0 takes a free one; None means ``local.port``.
            name: Name of this platform in messages and status; None means the name of the folder *state*.
            data: Whether robots get the data service under ``/data/``.
            adoptable: Whether servers and load balancer run on if this process is killed, and whether those
                that an earlier control plane left in *state* are taken over.
            control: The automatic actions of the control plane; None means none.
            on_event: Called with each event when it happens.
            program: The command that starts a server when ``serve`` and its options are appended.
            lan: Address of this machine at which robots of its network connect, by TLS; empty means
                ``serving.host``, which is loopback.
            metrics_port: Port of the control plane on loopback, with /metrics of all servers and /status.  0
                takes a free port; if the port is taken, a free one is used, with the event
                ``metrics-port-taken``.
            recorder: Records events and the samples of the monitor, which then always runs; None records
                nothing.
        """
        control = control or ControlOptions()
        if recorder is not None:
            control = _with_sample_observer(control, recorder.record_sample)
        self._recorder = recorder or NullPlatformRecorder()
        self.events: list[Event] = []
        self.url = ""
        self.name = name or state.name
        self.state = state.absolute()
        self.settings = settings
        store = local_placement(settings, self.state).store
        self._disks = DiskWatch(self.state, store, emit=self._emit)
        self._count = settings.local.servers if servers is None else servers
        self._wanted_port = settings.local.port if port is None else port
        self._has_data = data
        self._adoptable = adoptable
        self._on_event = on_event
        self.lan = LanListener(address=lan, folder=self.state) if lan else None
        self._lock = PlatformLock(self.state)
        self._audit = PlatformAudit(self.state, on_problem=self._report_unwritten_audit)
        self._metrics_port = metrics_port
        self._key: SigningKey | None = None
        self.backend_servers = LocalBackendServers(
            folder=self.state,
            dies_with_parent=not adoptable,
            warm_standby=settings.local.warm_standby,
            program=program,
        )
        self.load_balancer = EnvoyLoadBalancer(
            settings, folder=self.state, port=self._wanted_port, dies_with_parent=not adoptable,
            write=self._disks.write, lan=self.lan,
        )  # fmt: skip
        self._single_options: dict[str, Any] = {
            "folder": self.state, "dies_with_parent": not adoptable, "replaces": control.elastic,
            "program": program, "is_full": self._disks.is_full, "emit": self._report_single_change,
        }  # fmt: skip
        self.data_servers = local_data_server(settings, store=store, **self._single_options)
        self._rosbridge: WatchedServer | None = None
        """The rosbridge server; None without it, and until the port of the load balancer is known."""
        reports = FleetReports(emit=self._emit, changed=self._write_state)
        self._fleet = Fleet(
            self.backend_servers, self.load_balancer, settings,
            compress=control.compress, reports=reports,
        )  # fmt: skip
        self._fleet.is_full = self._disks.is_full
        self._operator_port = OperatorPort(
            self, metrics=self.backend_servers.metrics, disks=self._disks.document, keep=self._fleet.keep,
            emit=self._emit,
        )  # fmt: skip
        self._control = ControlPlane(
            self._fleet, self.load_balancer, settings, bounds_for(settings.scaling, self._count), control,
            reports,
        )  # fmt: skip

    @property
    def servers(self) -> tuple[BackendServer, ...]:
        """The backend servers that may get robots: announced, not exited, neither draining nor replaced."""
        return self._fleet.serving

    @property
    def metrics_url(self) -> str:
        """The address at which Prometheus reads the metrics of all servers."""
        return f"http://{_LOOPBACK}:{self._operator_port.port}/metrics"

    @property
    def port(self) -> int:
        """The port that robots connect to; 0 before the load balancer listens."""
        return self.load_balancer.port

    @property
    def sample(self) -> dict[str, Any] | None:
        """The newest sample of the monitor, as plain JSON values; None before the first."""
        sample = self._control.sample
        return None if sample is None else sample.document()

    async def __aenter__(self) -> LocalPlatform:
        """Start everything, or adopt the processes that an earlier control plane left running.

        Returns when robots can connect.  After an error nothing that was started runs on.

        Raises:
            ConfigurationError: A port is taken, the platform runs already, or a process did not start.
            MissingExtra: Envoy or the backend is not installed.
            UsageError: The number of servers is below 1.
        """
        began = time.monotonic()
        if self._count < 1:
            raise UsageError(f"a platform of {self._count} servers is empty", hint="start at least 1")
        self._make_folder()
        self._lock.take(self.name)
        try:
            previous = self._leftovers()
            if previous is None:
                host = self._wanted_address or self.settings.serving.host
                check_listener(host, self._wanted_port, is_protected=self.lan is not None)
            elif previous.lan != self._wanted_address:
                raise ConfigurationError(
                    f"servers of platform {self.name!r} still run, and robots connect to them at "
                    f"{previous.lan or 'loopback'}, not at {self._wanted_address or 'loopback'}",
                    hint=f"end them with: rse-pf local stop --name {self.name}",
                )
            if self.lan is not None:
                check_lan_settings(self.settings)
                self.lan.prepare(self.name, now_s=time.time())
            self._loop = asyncio.get_running_loop()
            self._audit.open()
        except ConfigurationError:
            self._lock.release()
            raise
        try:
            await self._start(previous, began + self.settings.local.start_timeout_s)
        except BaseException:
            await self._end()
            raise
        self._emit("platform-ready", url=self.url, seconds=round(time.monotonic() - began, 3))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop all processes of the platform."""
        await self._end()

    def issue_token(self, robot: str, ttl_s: float | None = None) -> str:
        """Return a token for *robot*, valid from now for *ttl_s* seconds (None: ``auth.token_ttl_s``).

        Raises:
            UsageError: The platform has not started, or *robot* is not a valid name.
        """
        if self._key is None:
            raise UsageError(
                "the platform has not started", hint="write: async with LocalPlatform(...) as platform"
            )
        return self._key.issue(
            robot,
            now=time.time(),
            token_id=secrets.token_hex(8),
            settings=self.settings.auth,
            ttl_s=ttl_s,
        )

    async def status(self) -> list[dict[str, Any]]:
        """Return the /status page of each backend server; servers that do not answer are left out."""
        pages = await asyncio.gather(*(self.backend_servers.status(server) for server in self.servers))
        return [page for page in pages if page is not None]

    def status_document(self) -> dict[str, Any]:
        """Return the state of the platform as plain JSON values: processes, last sample, policy, events."""
        mark = self.load_balancer.process.mark
        sample = self.sample
        servers = [
            {
                "name": member.name,
                "state": member.phase,
                "pid": None if member.server is None else member.server.pid,
                "port": None if member.server is None else member.server.port,
                "control_port": None if member.server is None else member.server.control_port,
            }
            for member in self._fleet.members.values()
        ]
        read = {row["name"]: row for row in ([] if sample is None else sample["servers"])}
        return {
            "platform": self.name,
            "url": self.url,
            "settings_digest": self.settings.digest(),
            "balancer": {
                "pid": None if mark is None else mark.pid,
                "port": self.load_balancer.port,
                "running": self.load_balancer.process.is_running(),
            },
            "servers": [{**read.get(str(row["name"]), {}), **row} for row in servers],
            "data_servers": self.data_servers.document(),
            "disks": self._disks.document(),
            "sample": sample,
            "policy": self._control.document(),
            "events": [dict(event) for event in self.events[-_LAST_EVENTS:]],
        }

    # --- operations that change the servers -------------------------------------------------------

    async def grow(self, n: int, reason: str) -> list[str]:
        """Launch *n* servers and wait until robots are sent to them; return their names.

        Raises:
            ConfigurationError: One of them did not become healthy.
        """
        names = list(self._fleet.grow(n))
        self._emit("grow", servers=n, names=names, reason=reason)
        await self._wait_until_healthy(names)
        return names

    async def drain(self, name: str, reason: str = "asked") -> dict[str, Any]:
        """Have server *name* move its robots and exit, wait for it, and return the report of the drain.

        The report has the keys server, seconds and ``clean``: whether the server drained without being
        killed.  If a drain of *name* is under way, only its end is waited for, and ``clean`` is True.

        Raises:
            UsageError: There is no such server, or it is the last one.
        """
        member = self.check_drain(name)
        began = time.monotonic()
        if member.leaving:
            await member.over.wait()
            return {"server": name, "seconds": round(time.monotonic() - began, 3), "clean": True}
        self._fleet.begin_drain(member, reason)
        return await self._fleet.finish_drain(member, began)

    def check_drain(self, name: str) -> Member:
        """Return the server *name*; raises UsageError if there is none, or it is the last one."""
        member = self._fleet.member(name)
        if all(server.name == name for server in self.servers):
            raise UsageError(
                f"{name} is the last server",
                hint="rse-pf local roll starts another one first",
            )
        return member

    async def replace(self, name: str, reason: str) -> str:
        """Kill server *name*, launch another in its place, and wait until robots are sent to that one.

        Returns the name of the new server.  A server that drains already is not killed.

        Raises:
            UsageError: There is no such server.
            ConfigurationError: The new server did not become healthy.
        """
        self._fleet.member(name)
        new = self._fleet.launch_replacement(name)
        self._emit("replace", servers=1, server=name, by=new, reason=reason)
        await self._wait_until_healthy([new])
        return new

    def check_roll(self, settings: PlatformSettings) -> SettingsChange:
        """Return what a roll with *settings* changes.

        Raises:
            UsageError: Nothing changes, or a change needs a restart of the platform.
            ConfigurationError: The platform is open to its network, and the settings are not allowed there.
        """
        change = settings_change(self.settings, settings)
        if self.lan is not None:
            check_lan_settings(change.settings)
        return change

    async def roll(self, change: SettingsChange | None = None) -> None:
        """Replace every backend server, one by one: the new one serves before the old one is drained.

        The data server and the rosbridge server are replaced last; clients of the data service repeat
        requests that failed meanwhile, rosbridge clients have to connect again.  A warm standby process is
        killed first, since it has the old release in its memory.

        Args:
            change: The settings of the new servers; None leaves the settings as they are.

        Raises:
            ConfigurationError: A new server did not become healthy and was killed; the roll has stopped, the
                old servers that are left serve on, and servers that start later have the old settings.  Or
                every backend server was replaced, and the data server or the rosbridge server does not start.
        """
        before = self.settings
        if change is not None:
            self._emit("roll-settings", settings=change.words)
            self._write_settings(change.settings)
        try:
            await self._replace_servers()
        except BaseException:
            self._write_settings(before)
            raise
        self._fleet.settings = self._control.settings = self.settings
        self._write_state()
        await self.data_servers.restart(STOP_TIMEOUT_S)
        if self._rosbridge is not None:
            await self._rosbridge.restart(STOP_TIMEOUT_S)

    def _write_settings(self, settings: PlatformSettings) -> None:
        """Write *settings* to the file that servers read at their start, and use them from now on.

        Raises:
            ConfigurationError: The file cannot be written; the settings stay as they were.
        """
        file = settings_file(self.state)
        try:
            replace_json(file, local_placement(settings, self.state).document(settings), indent=1)
        except OSError as error:
            raise ConfigurationError(
                f"{file} cannot be written: {error.strerror}", hint="free some space, or make it writable"
            ) from error
        self.settings = settings

    async def _replace_servers(self) -> None:
        """Replace the present servers one by one, while the scale modifier does not change their number."""
        self._control.hold = True
        try:
            # Servers that are still starting are replaced, too: they may have read the former settings.
            servers = [m.name for m in self._fleet.members.values() if not (m.leaving or m.out)]
            await self._wait_until_healthy(servers)
            self.backend_servers.standby.close()
            for number, old in enumerate(servers, 1):
                self._emit("roll-step", server=old, number=number, of=len(servers))
                await self.backend_servers.standby.wait_warm(self.settings.local.start_timeout_s)
                names = list(self._fleet.grow(1, on_trial=True))
                try:
                    await self._wait_until_healthy(names)
                except ConfigurationError as error:
                    for name in names:
                        self._fleet.withdraw(name)
                    self._emit("roll-stopped", server=names[0], number=number, of=len(servers))
                    raise ConfigurationError(
                        f"the roll stopped at new server {number} of {len(servers)}: {error.message}",
                        hint=f"the old servers serve on; read the log {names[0]}.log, then roll again",
                    ) from error
                if old in self._fleet.members:
                    await self.drain(old, reason="rolling replacement")
        finally:
            self._control.hold = False
            self._control.watch_spread()

    # --- faults that an operator or an experiment injects -----------------------------------------

    def kill(self, name: str) -> None:
        """Send SIGKILL to server *name*, like a crash; raises UsageError if there is none."""
        self._fleet.member(name)
        self.backend_servers.send(name, signal.SIGKILL)
        self._emit("server-killed", server=name)

    def pause(self, name: str) -> None:
        """Stop the processes of server *name* with SIGSTOP, like a hang; raises UsageError if unknown."""
        self._signal_all(name, signal.SIGSTOP)
        self._emit("server-paused", server=name)

    def resume(self, name: str) -> None:
        """Continue all processes of the paused server *name*; raises UsageError if there is none."""
        self._signal_all(name, signal.SIGCONT)
        self._emit("server-resumed", server=name)

    def kill_balancer(self) -> None:
        """Send SIGKILL to the load balancer, which cuts every connection; an elastic platform restarts it."""
        mark = self.load_balancer.process.mark
        self._emit("balancer-killed", pid=None if mark is None else mark.pid)
        if mark is not None:
            send_signal(mark, signal.SIGKILL)

    def _signal_all(self, name: str, number: signal.Signals) -> None:
        server = self._fleet.member(name).server
        self.backend_servers.send(name, number)
        for mark in () if server is None else server.worker_marks:
            send_signal(mark, number)

    async def _wait_until_healthy(self, names: Sequence[str]) -> None:
        members = [self._fleet.members[name] for name in names if name in self._fleet.members]
        await self._fleet.wait_until_healthy(members, 2 * self.settings.local.start_timeout_s)

    # --- start of the platform --------------------------------------------------------------------

    def _make_folder(self) -> None:
        try:
            self.state.mkdir(mode=0o700, parents=True, exist_ok=True)
            self.state.chmod(0o700)
        except OSError as error:
            raise ConfigurationError(
                f"cannot use the folder {self.state}: {error.strerror}",
                hint="make it writable for you, or set XDG_STATE_HOME",
            ) from error

    @property
    def _wanted_address(self) -> str:
        return "" if self.lan is None else self.lan.address

    def _leftovers(self) -> PlatformState | None:
        """Return the state that an earlier control plane left; None if none of its processes still runs.

        Raises:
            ConfigurationError: Processes still run, and this platform is not adoptable.
        """
        state = read_state(self.state)
        if state is None or not any(map(is_alive, state.processes())):
            return None
        if not self._adoptable:
            raise ConfigurationError(
                f"servers of platform {self.name!r} outlived their control plane",
                hint=f"end them with: rse-pf local stop --name {self.name}",
            )
        return state

    async def _start(self, previous: PlatformState | None, end: float) -> None:
        """Start or adopt all processes until *end* (monotonic), then the operator's port and the loops."""
        self._key = ensure_key(self.state, seed=secrets.token_bytes(32), key_id=secrets.token_hex(4))
        token = ensure_control_token(control_token_file(self.state), seed=secrets.token_bytes(32))
        self._write_settings(self.settings)
        self._recorder.begin()
        self._disks.prepare()
        self._control.start_checks()
        if previous is None:
            await self._begin(end)
        else:
            await run_together(self._adopt(previous, end), self._begin_data(previous.data_server))
        self.url = robots_url(self.settings, self.port, self.lan)
        if self.settings.serving.rosbridge:
            await self._begin_rosbridge(previous)
        elif previous is not None and previous.rosbridge_server is not None:
            send_signal(previous.rosbridge_server.process, signal.SIGTERM)
        await self._open_operator_port(token, 0 if previous is None else previous.status_port)
        self._disks.on_space = self._control.retry_replacements
        self._fleet.keep(self._disks.watch())
        self._fleet.keep(rotate_logs(self.state, _LOG_FILE_BYTES, self._fleet.members))
        if os.getpid() == 1:
            self._fleet.keep(reap_orphans())
        if self.lan is not None:
            renewed = functools.partial(self._emit, "certificate-renewed")
            self._fleet.keep(self.lan.keep_valid(self.name, renewed, self._report_unwritten_state))
        self._control.start()
        self._write_state()

    async def _begin(self, end: float) -> None:
        """Launch load balancer, backend servers and data server, and wait until all serve."""
        self.load_balancer.launch()
        members = [self._fleet.launch() for _ in range(self._count)]
        await run_together(
            self.load_balancer.wait_live(end - time.monotonic()),
            *(self._fleet.bring_up(member, end - time.monotonic()) for member in members),
            *((self.data_servers.start(),) if self._has_data else ()),
        )

    async def _adopt(self, previous: PlatformState, end: float) -> None:
        """Adopt the balancer and the servers of *previous* that still run, and launch what is missing.

        No server or balancer that runs is killed or restarted; servers keep their names, and the balancer
        keeps its port.  Returns once one server gets robots.

        Raises:
            ConfigurationError: The balancer does not listen, or no server got robots, until *end*
                (monotonic).
        """
        balancer_lives = previous.load_balancer is not None and is_alive(previous.load_balancer)
        self.load_balancer.adopt(previous.load_balancer if balancer_lives else None, port=previous.port)
        self._fleet.launched = previous.launched
        alive = [server for server in previous.servers if is_alive(server.process)]
        members = []
        for server in alive:
            self.backend_servers.adopt(server.name, server.process)
            members.append(
                self._fleet.adopt(server.name, now_s=time.monotonic(), is_target=bool(server.port))
            )
        digests = {server.name: await self._settings_digest(server) for server in alive}
        self._emit(
            "adopted",
            servers=list(digests),
            balancer=balancer_lives,
            settings_digest=previous.settings_digest,
            digests=digests,
        )
        if not balancer_lives:
            self.load_balancer.launch()
        await self.load_balancer.wait_live(end - time.monotonic())
        if not members:
            members = [self._fleet.launch() for _ in previous.servers] or [self._fleet.launch()]
        for member in members:
            self._fleet.start(member)
        waiting = [asyncio.ensure_future(member.healthy.wait()) for member in members]
        try:
            left_s = max(end - time.monotonic(), 0.0)
            done, _ = await asyncio.wait(waiting, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for wait in waiting:
                wait.cancel()
        if not done:
            names = ", ".join(member.name for member in members)
            raise ConfigurationError(
                f"none of the adopted servers became healthy: {names}",
                hint="read their logs: rse-pf local logs, or stop them: rse-pf local stop",
            )

    async def _settings_digest(self, server: ServerState) -> str | None:
        """Return the digest of the settings that *server* runs with; None if it does not answer."""
        if not server.port:
            return None
        port = self.backend_servers.control(server.control_port)
        reply = await port.ask_once("/status", timeout_s=_STATUS_TIMEOUT_S)
        return None if reply is None else str(reply.document().get("settings", "")) or None

    async def _begin_data(self, previous: ServerState | None) -> None:
        """Adopt the data server *previous* if it runs, else start one if robots get the data service."""
        if self._has_data or (previous is not None and is_alive(previous.process)):
            await self._begin_single(self.data_servers, DATA_CLUSTER, previous)

    async def _begin_rosbridge(self, previous: PlatformState | None) -> None:
        """Start the rosbridge server, or adopt the one of *previous* if its load balancer still runs.

        One whose balancer has exited is killed first: it connects to a port of that balancer.
        """
        if not self.load_balancer.loopback_port:
            # The balancer was started without rosbridge, or by an earlier release, and keeps its listeners.
            self._emit("rosbridge-failed", name="rosbridge", error="the platform has to be restarted for it")
            return
        url = f"ws://{_LOOPBACK}:{self.load_balancer.loopback_port}{ROBOTS_PATH}"
        self._rosbridge = local_rosbridge_server(self.settings, url=url, **self._single_options)
        earlier = None if previous is None else previous.rosbridge_server
        balancer = None if previous is None else previous.load_balancer
        if earlier is not None and balancer != self.load_balancer.process.mark:
            send_signal(earlier.process, signal.SIGKILL)
            await ended(earlier.process)
        await self._begin_single(self._rosbridge, ROSBRIDGE_CLUSTER, earlier)

    async def _begin_single(self, server: WatchedServer, cluster: str, previous: ServerState | None) -> None:
        """Adopt the process *previous* if it runs, else start one, on its old port if that is free."""
        if previous is not None and previous.port and is_alive(previous.process):
            server.adopt(previous.process, previous.port)
            self.load_balancer.set_targets([server.target], cluster)
            return
        if previous is not None:
            send_signal(previous.process, signal.SIGKILL)  # it had not announced itself: its port is unknown
        await server.start(0 if previous is None else previous.port)

    async def _open_operator_port(self, token: str, earlier: int) -> None:
        """Open the operator's port: the wanted one, else the *earlier* one, else any free one."""
        await self._operator_port.open(
            token, ports=[port for port in (self._metrics_port, earlier) if port] + [0]
        )
        if self._metrics_port not in (0, self._operator_port.port):
            self._emit("metrics-port-taken", port=self._metrics_port)

    def _write_state(self) -> None:
        """Write the state file and the targets for Prometheus, or have them written once there is space."""
        control_plane = mark_of(os.getpid())
        assert control_plane is not None
        ports = {
            member.name: {"port": member.server.port, "control_port": member.server.control_port}
            for member in self._fleet.members.values()
            if member.server is not None
        }
        state = PlatformState(
            name=self.name,
            control_plane=control_plane,
            url=self.url,
            settings_digest=self.settings.digest(),
            settings_file=str(settings_file(self.state)),
            key_file=str(key_file(self.state)),
            control_token_file=str(control_token_file(self.state)),
            servers=tuple(
                ServerState(name=name, process=mark, **ports.get(name, {}))
                for name, mark in self.backend_servers.marks.items()
            ),
            data_server=self.data_servers.state,
            rosbridge_server=None if self._rosbridge is None else self._rosbridge.state,
            load_balancer=self.load_balancer.process.mark,
            port=self.load_balancer.port,
            status_port=self._operator_port.port,
            launched=self._fleet.launched,
            lan=self._wanted_address,
            authority_file="" if self.lan is None else str(authority_file(self.state)),
        )
        self._disks.write(state_file(self.state), state.to_json())
        self._disks.write(self.state / _TARGETS_FILE, service_discovery(self.name, state.servers))

    def _report_single_change(self, event: str, **details: Any) -> None:
        """Emit an event of the data or rosbridge server; make one that is up the balancer's target."""
        self._emit(event, **details)
        if event == "data-server-up":
            self.load_balancer.set_targets([self.data_servers.target], DATA_CLUSTER)
        elif event == "rosbridge-up" and self._rosbridge is not None:
            self.load_balancer.set_targets([self._rosbridge.target], ROSBRIDGE_CLUSTER)
        self._write_state()

    # --- stop of the platform, and its events -----------------------------------------------------

    async def _end(self) -> None:
        """Stop servers, then the load balancer; kill processes that are left, also after an error.

        The servers exit first, so that they close their robots' connections themselves.
        """
        try:
            self._control.stop()
            await self._fleet.close()
            self._operator_port.close()
            if self._rosbridge is not None:
                await self._rosbridge.stop(STOP_TIMEOUT_S)
            await asyncio.gather(
                self.backend_servers.stop(STOP_TIMEOUT_S), self.data_servers.stop(STOP_TIMEOUT_S)
            )
            await self.load_balancer.stop(STOP_TIMEOUT_S)
        finally:
            self.backend_servers.kill_all()
            self.data_servers.kill_all()
            if self._rosbridge is not None:
                self._rosbridge.kill_all()
            self.load_balancer.kill()
            self._fleet.members.clear()
            with contextlib.suppress(OSError):  # the folder may have been removed meanwhile
                remove_state(self.state)
                (self.state / _TARGETS_FILE).unlink(missing_ok=True)
                if not self._adoptable:  # no later platform uses these keys, so its tokens are worthless
                    key_file(self.state).unlink(missing_ok=True)
                    control_token_file(self.state).unlink(missing_ok=True)
            self._recorder.close()
            self._audit.close()
            self._lock.release()
        await asyncio.sleep(0)  # lets a problem that the audit log reported while it closed become an event
        self._emit("platform-gone")

    def _report_unwritten_state(self, problem: str) -> None:
        self._emit("not-written", reason=problem)

    def _report_unwritten_audit(self, problem: str) -> None:
        """Report *problem* in the event loop; the thread of the audit log calls this."""
        self._loop.call_soon_threadsafe(self._report_unwritten_state, problem)

    def _emit(self, event: str, **details: Any) -> None:
        """Append an event to ``events``; pass it to audit log, recorder, operator's port and callback."""
        entry = {"event": event, **details}
        self.events.append(entry)
        self._audit.record(entry)
        self._recorder.record_event(entry)
        self._operator_port.take_event(entry)
        if self._on_event is not None:
            self._on_event(entry)


def _with_sample_observer(
    options: ControlOptions, observe: Callable[[Mapping[str, Any]], None]
) -> ControlOptions:
    """Return *options* whose ``on_sample`` calls *observe* with each sample, then the previous callback."""
    before = options.on_sample

    def observe_both(sample: Mapping[str, Any]) -> None:
        observe(sample)
        if before is not None:
            before(sample)

    return dataclasses.replace(options, on_sample=observe_both)
