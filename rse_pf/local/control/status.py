"""Read the state of a platform from its processes, and format it as the table of ``rse-pf local status``.

This works without the control plane: the state file names the processes, and each server answers on its
control port.  Nothing is changed, and a server that does not answer delays the result by two time limits at
most.
"""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rse_pf.auth.control_token import read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH
from rse_pf.errors import ConfigurationError
from rse_pf.local.disk_watch import DiskSpace, disk_line, disk_spaces, folders_of
from rse_pf.local.processes import ProcessMark, is_alive
from rse_pf.local.servers.backend_servers import local_placement
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import PlatformState, ServerState, platform_settings
from rse_pf.terminal import printable

__all__ = ["data_url", "platform_status", "status_table"]

# Time limit of one request to a server, in seconds.
_TIMEOUT_S = 0.5
# The table names this many tenants, those with the most CPU time; --json has all.
_MAX_TENANTS = 5
_COLUMNS = ("server", "pid", "state", "robots", "CPU %", "requests/s", "queue")


async def platform_status(state: PlatformState, *, sample_s: float) -> dict[str, Any]:
    """Return the state of all processes of the platform in *state*, as plain JSON values.

    The status of each backend server is read twice, *sample_s* seconds apart; CPU load (in % of what the
    server may use) and requests/s are the means between the two.

    Raises:
        UsageError: The control ports require a token, and its file cannot be read.
    """
    file = state.control_token_file
    token = read_control_token(Path(file)) if file else None
    data = () if state.data_server is None else (state.data_server,)
    rosbridge = () if state.rosbridge_server is None else (state.rosbridge_server,)
    servers, data_servers, rosbridge_servers = await asyncio.gather(
        asyncio.gather(*(_server(server, token, sample_s) for server in state.servers)),
        asyncio.gather(*(_single_server(server, "/data/readyz") for server in data)),
        asyncio.gather(*(_single_server(server, HEALTH_PATH) for server in rosbridge)),
    )
    balancer = state.load_balancer
    folder = Path(state.settings_file).parent
    disks = await asyncio.to_thread(_disks, folder)
    return {
        "platform": state.name,
        "url": state.url,
        "control_plane": {"pid": state.control_plane.pid, "running": is_alive(state.control_plane)},
        "balancer": {
            "pid": None if balancer is None else balancer.pid,
            "port": state.port,
            "running": balancer is not None and is_alive(balancer) and not _is_stopped(balancer.pid),
        },
        "servers": list(servers),
        "data_servers": list(data_servers),
        "rosbridge_servers": list(rosbridge_servers),
        "disks": [{**asdict(space), "warning": disk_line(space)} for space in disks],
    }


def status_table(status: Mapping[str, Any]) -> str:
    """Return the result of `platform_status` as the lines of a table, separated by newlines."""
    rows = [_COLUMNS, *(_row(server) for server in status["servers"])]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    lines = [
        "  ".join(
            cell.ljust(width) if i in (0, 2) else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    for role in ("data", "rosbridge"):
        for process in status.get(f"{role}_servers", ()):
            lines.append(f"{role} server  {process['name']} is {process['state']} (pid {process['pid']})")
    for role, process in (("load balancer", status["balancer"]), ("control plane", status["control_plane"])):
        lines.append(f"{role}  {'runs' if process['running'] else 'does not run'} (pid {process['pid']})")
    taken: defaultdict[str, float] = defaultdict(float)
    for server in status["servers"]:
        for tenant, taken_s in server.get("tenant_cpu_s", {}).items():
            taken[tenant] += taken_s
    if len(taken) > 1:  # with one tenant, its CPU time is that of all servers
        most = sorted(taken, key=taken.__getitem__, reverse=True)[:_MAX_TENANTS]
        shown = ", ".join(f"{tenant} {taken[tenant]:.1f} s" for tenant in most)
        lines.append(f"computed for tenants  {shown}")
    lines += [disk["warning"] for disk in status.get("disks", ()) if disk["warning"]]
    lines.append(f"robots connect to  {status['url'] or 'nothing yet'}")
    if status["data_servers"] and status["url"]:
        lines.append(f"large data goes to  {data_url(status['url'])}")
    return "\n".join(map(printable, lines))


def data_url(url: str) -> str:
    """Return the address of the data service, from the address *url* that robots connect to."""
    parts = urlsplit(url)
    return f"{'https' if parts.scheme == 'wss' else 'http'}://{parts.netloc}/data/"


def _disks(folder: Path) -> list[DiskSpace]:
    """Return the file systems that the platform in *folder* writes to.

    If its settings are of another version, those of the default settings.
    """
    try:
        settings = platform_settings(folder) or PlatformSettings()
    except ConfigurationError:  # settings of another version
        settings = PlatformSettings()
    return disk_spaces(folders_of(folder, local_placement(settings, folder).store))


async def _single_server(server: ServerState, ready: str) -> dict[str, Any]:
    """Return name, pid, port and state of the data or rosbridge server, ready if path *ready* answers 200."""
    row: dict[str, Any] = {"name": server.name, "pid": server.process.pid, "port": server.port}
    silent = _state_without_answer(server.process, server.port)
    if silent is not None:
        return {**row, "state": silent}
    reply = await ControlPort(server.port).ask_once(ready, timeout_s=_TIMEOUT_S)
    if reply is None:
        return {**row, "state": "silent"}
    return {**row, "state": "ready" if reply.status == 200 else "not ready"}


async def _server(server: ServerState, token: str | None, sample_s: float) -> dict[str, Any]:
    """Return the row of one backend server; only name, pid and state if it does not answer."""
    row: dict[str, Any] = {"name": server.name, "pid": server.process.pid}
    silent = _state_without_answer(server.process, server.control_port)
    if silent is not None:
        return {**row, "state": silent}
    port = ControlPort(server.control_port, token)
    try:
        first, began = await _read_status(port), time.monotonic()
        await asyncio.sleep(sample_s)
        second, wall_s = await _read_status(port), time.monotonic() - began
    except ConnectionError:
        return {**row, "state": "silent"}
    finally:
        port.close()
    workers = len(second["workers"])
    emulated = second.get("emulated_cores", 0.0)
    cores = emulated * workers if emulated else workers
    return {
        **row,
        **{key: second[key] for key in ("state", "robots", "queue", "queue_ms", "in_flight", "moved")},
        "requests": second["requests"],
        "requests_per_s": round((second["requests"] - first["requests"]) / wall_s, 1),
        "cpu_percent": round(100 * (second["cpu_s"] - first["cpu_s"]) / (wall_s * cores), 1),
        "bytes_in": second["bytes_in"],
        "bytes_out": second["bytes_out"],
        "tenant_cpu_s": second.get("tenant_cpu_s", {}),
    }


async def _read_status(port: ControlPort) -> dict[str, Any]:
    """Return the /status page at *port*; raises ConnectionError if there is none."""
    reply = await port.ask("/status", timeout_s=_TIMEOUT_S)
    document = reply.document()
    if reply.status != 200 or "workers" not in document:
        raise ConnectionError(f"the control port answers {reply.status}")
    return document


def _state_without_answer(process: ProcessMark, port: int) -> str | None:
    """Return why a process cannot answer: ``gone``, ``stopped`` or ``starting``; None if it can."""
    if not is_alive(process):
        return "gone"
    if _is_stopped(process.pid):
        return "stopped"
    return None if port else "starting"


def _row(server: Mapping[str, Any]) -> tuple[str, ...]:
    keys = ("name", "pid", "state", "robots", "cpu_percent", "requests_per_s", "queue")
    return tuple(str(server.get(key, "-")) for key in keys)


def _is_stopped(pid: int) -> bool:
    """Return whether a signal or a debugger has stopped process *pid*; False if there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return False
    return text.rpartition(")")[2].split()[0] in "Tt"
