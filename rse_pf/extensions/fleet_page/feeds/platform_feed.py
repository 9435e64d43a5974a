"""The feed of one local platform: it reads the control plane's operator port, the servers and the logs.

The control plane is sent a single request, for its stream of states and events.  Servers are requested for
their histograms, and for their robots only while a page is open.  After an error, a request is repeated.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.audit.entry import Entry
from rse_pf.auth.control_token import read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.fleet_page.feeds.audit_log import AuditRows
from rse_pf.extensions.fleet_page.feeds.command_log import CommandLog
from rse_pf.extensions.fleet_page.feeds.percentiles import LastMinute, buckets_of
from rse_pf.extensions.fleet_page.feeds.sentences import waiting_for
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.local.events import event_sentence, group_of
from rse_pf.local.processes import is_alive, mark_of
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.state import platform_settings, read_state
from rse_pf.local.together import run_together
from rse_pf.scaling.profile import cadence_of
from rse_pf.terminal import printable

__all__ = ["LocalFeed", "fleet_document", "moved_robots"]

# Time between two readings of the servers' robots, in seconds.
_ROBOTS_EVERY_S = 1.0
# Time between two readings of the servers' histograms, in seconds.
_METRICS_EVERY_S = 5.0
# Time between the first two readings of the histograms, in seconds: percentiles are computed from two
# readings.
_FIRST_METRICS_S = 1.0
# Time between two readings of the servers' logs, in seconds.
_LOGS_EVERY_S = 0.3
# Time between two readings of the audit logs, in seconds.
_AUDIT_EVERY_S = 0.5
# Pause before the stream of the control plane is requested again, in seconds.
_RETRY_S = 0.5
# Time limit of a request to a server, in seconds.
_REQUEST_TIMEOUT_S = 2.0
# Number of samples in the charts: the last ten minutes.
_CHART_SAMPLES = 600
# Largest number of characters of a text.
_MAX_TEXT = 300
# Largest number of events about moved robots after one reading.
_MAX_MOVE_EVENTS = 50
# Largest number of robots without a connection to a server for which the last server is still stored.
_MAX_ABSENT_ROBOTS = 500
# Exceptions of an unexpected answer, such as that of a server of another version or of one that is being
# killed.
_UNEXPECTED_ANSWER_ERRORS = (RsePfError, OSError, ValueError, KeyError, TypeError)


class LocalFeed:
    """Puts state, robots, commands and events of one local platform into a `Hub`."""

    def __init__(self, hub: Hub, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        """Prepare the feed of the platform whose state is in *folder*; *clock* returns seconds, monotonic."""
        self._hub = hub
        self._folder = folder
        self._clock = clock
        self._settings = PlatformSettings()
        self._log = CommandLog(folder)
        self._audit = AuditRows(folder)
        self._watched_s = (math.inf, math.inf)
        self._minute = LastMinute()
        self._percentiles: dict[str, Any] = {}
        self._where: dict[str, str] = {}
        self._history: deque[list[float | None]] = deque(maxlen=_CHART_SAMPLES)
        self._connected = False
        self._sampled_s: float | None = -1.0

    async def run(self) -> None:
        """Read and publish until cancelled."""
        await run_together(
            self._watch(), self._follow_robots(), self._follow_metrics(), self._follow_logs(),
            self._follow_audit(),
        )  # fmt: skip

    # --- the stream of the control plane -------------------------------------------------------

    async def _watch(self) -> None:
        while True:
            # The control plane may be restarting or stopped: the stream is requested again after a pause.
            with contextlib.suppress(OSError, ValueError, EOFError, RsePfError, asyncio.TimeoutError):
                await self._watch_once()
            if self._connected:
                self._connected = False
                self._watched_s = (self._watched_s[0], time.time())
                self._event({"event": "control-plane-silent", "time_s": time.time()})
            self._hub.put("link", "control_plane", {"connected": False, "time_s": time.time()})
            await asyncio.sleep(_RETRY_S)

    async def _watch_once(self) -> None:
        state = await asyncio.to_thread(read_state, self._folder)
        if state is None or not state.status_port or not is_alive(state.control_plane):
            return
        self._settings = platform_settings(self._folder) or PlatformSettings()
        token = read_control_token(Path(state.control_token_file))
        port = ControlPort(state.status_port, token)
        async with contextlib.aclosing(
            port.follow("/watch", silence_s=_REQUEST_TIMEOUT_S + 3.0, method="GET")
        ) as messages:
            async for message in messages:
                if not self._connected:
                    self._connected = True
                    self._watched_s = (time.time(), math.inf)
                    self._hub.put("link", "control_plane", {"connected": True, "time_s": time.time()})
                if "state" in message:
                    self._take(message["state"])
                else:
                    self._event(message)

    def _take(self, state: Mapping[str, Any]) -> None:
        now = time.time()
        sample = state.get("sample") or {}
        document = fleet_document(state, self._settings, time_s=now)
        for server in document["servers"]:
            server["age_s"] = _age_s(server["pid"])
        # Both processes run on one machine, so that the control plane has the same monotonic clock.
        if sample:
            document["sample_age_s"] = round(time.monotonic() - float(sample["time"]), 3)
        document["percentiles"] = self._percentiles
        document["pages"] = self._hub.pages
        self._hub.put("fleet", "now", document)
        if sample.get("time") == self._sampled_s:
            return  # the state was sent because of an event, with the same sample as before
        self._sampled_s = sample.get("time")
        row = [round(now, 2), document["cpu_percent"], sample.get("requests"), sample.get("robots")]
        self._history.append([*row, self._percentiles.get("p99_ms")])
        self._hub.put("history", "minutes", [list(column) for column in zip(*self._history, strict=True)])

    def _event(self, event: Mapping[str, Any]) -> None:
        kind = str(event.get("event", ""))
        row = {
            "time_s": event.get("time_s", time.time()),
            "kind": printable(kind),
            "text": printable(event_sentence(event))[:_MAX_TEXT],
            "server": printable(str(event.get("server", event.get("name", "")))),
            "group": group_of(kind),
        }
        self._hub.append("event", row)

    # --- requests to servers, and their logs ---------------------------------------------------

    async def _follow_robots(self) -> None:
        while True:
            if self._hub.watches("robots"):
                with contextlib.suppress(*_UNEXPECTED_ANSWER_ERRORS):
                    await self._read_robots()
            await asyncio.sleep(_ROBOTS_EVERY_S)

    async def _read_robots(self) -> None:
        names, replies = await self._ask_servers("/robots")
        rows: list[list[Any]] = []
        for name, page in zip(names, replies, strict=True):
            for row in json.loads(page).get("robots", []) if page else []:
                robot = _robot(str(row["tenant"]), str(row["robot"]))
                last = printable(str(row["last_result"] or "-"))
                who = [printable(str(row["tenant"])), printable(str(row["robot"]))]
                rows.append([robot, name, row["codec"], row["connected_s"], row["commands"], last, *who])
        where = {str(row[0]): str(row[1]) for row in rows}
        for robot, before, after in moved_robots(self._where, where)[:_MAX_MOVE_EVENTS]:
            self._event({"event": "robot-moved", "robot": robot, "before": before, "server": after})
        # A robot that moves is on no server for a moment, so that the last servers of absent robots are
        # stored.
        gone = [item for item in self._where.items() if item[0] not in where][-_MAX_ABSENT_ROBOTS:]
        self._where = {**dict(gone), **where}
        self._hub.put("robots", "now", rows)

    async def _follow_metrics(self) -> None:
        """Read the histograms of all servers, also while no page is open.

        A page that is opened later thus has the percentiles of the last minute at once.
        """
        while True:
            with contextlib.suppress(*_UNEXPECTED_ANSWER_ERRORS):
                await self._read_metrics()
            is_first = not self._percentiles.get("covered_s")
            await asyncio.sleep(_FIRST_METRICS_S if is_first else _METRICS_EVERY_S)

    async def _read_metrics(self) -> None:
        names, replies = await self._ask_servers("/metrics")
        now_s = self._clock()
        for name, page in zip(names, replies, strict=True):
            if page:
                self._minute.add(name, buckets_of(page.decode("utf-8", "replace")), now_s=now_s)
        self._percentiles = self._minute.document(now_s=now_s, servers=names)

    async def _ask_servers(self, target: str) -> tuple[list[str], list[bytes | None]]:
        state = await asyncio.to_thread(read_state, self._folder)
        servers = [] if state is None else [server for server in state.servers if server.control_port]
        if state is None or not servers:
            return [], []
        token = read_control_token(Path(state.control_token_file)) if state.control_token_file else None
        replies = await asyncio.gather(
            *(
                ControlPort(server.control_port, token).ask_once(target, timeout_s=_REQUEST_TIMEOUT_S)
                for server in servers
            )
        )
        pages = [None if reply is None or reply.status != 200 else reply.body for reply in replies]
        return [server.name for server in servers], pages

    async def _follow_logs(self) -> None:
        while True:
            for row in await asyncio.to_thread(self._log.new_rows):
                self._hub.append("pose", row)
            await asyncio.sleep(_LOGS_EVERY_S)

    async def _follow_audit(self) -> None:
        while True:
            rows, events = await asyncio.to_thread(self._audit.new_rows, self._was_watched)
            for row in rows:
                self._hub.append("audit", row)
            for event in events:
                self._event(event)
            await asyncio.sleep(_AUDIT_EVERY_S)

    def _was_watched(self, entry: Entry) -> bool:
        """Return whether the control plane sent the event of *entry* in its stream as well.

        Events from before the connection to its stream, or after the loss of it, are in the log only.
        """
        return self._watched_s[0] <= entry.time <= self._watched_s[1]


def fleet_document(state: Mapping[str, Any], settings: PlatformSettings, *, time_s: float) -> dict[str, Any]:
    """Return the document that the Fleet view shows for *state* of the control plane; texts are escaped.

    *time_s* is the present time in Unix seconds.
    """
    sample = state.get("sample") or {}
    policy = state.get("policy") or {}
    servers = [_server(server) for server in state.get("servers", [])]
    counted = sum(server["state"] in ("starting", "healthy", "unhealthy") for server in servers)
    return {
        "time_s": time_s,
        "platform": printable(str(state.get("platform", ""))),
        "url": printable(str(state.get("url", ""))),
        "tls": str(state.get("url", "")).startswith("wss:"),
        "balancer": bool((state.get("balancer") or {}).get("running")),
        "robots": sample.get("robots", 0),
        "requests": sample.get("requests", 0),
        "cpu_percent": _mean_cpu(servers),
        "queue_ms": sample.get("queue_ms", 0.0),
        "bytes_in": sample.get("bytes_in", 0),
        "bytes_out": sample.get("bytes_out", 0),
        "servers": servers,
        "data_servers": [_data_server(server) for server in _mappings_in(state.get("data_servers"))],
        "waiting": waiting_for(policy, settings.scaling, servers=counted),
        "last_action": printable(str(((policy.get("last_action") or {}).get("reason")) or "")),
        "min_servers": policy.get("min_servers"),
        "max_servers": policy.get("max_servers"),
        "busy_percent": settings.scaling.busy_cpu_percent,
        "period_s": cadence_of(settings.scaling).period_s / float(policy.get("compress", 1.0)),
    }


def moved_robots(before: Mapping[str, str], after: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Return robot, old server and new server of each robot whose server changed.

    *before* and *after* map robots to servers; robots that are not in both are left out.
    """
    return [
        (robot, before[robot], server)
        for robot, server in after.items()
        if robot in before and before[robot] != server
    ]


def _robot(tenant: str, name: str) -> str:
    return printable(name if tenant in ("", DEFAULT_TENANT) else f"{tenant}/{name}")


def _mean_cpu(servers: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the mean CPU (%) of all servers that reported theirs, also those that warm up.

    The result is None if no server reported its CPU.
    """
    percents = [float(server["cpu_percent"]) for server in servers if server["cpu_percent"] is not None]
    return round(sum(percents) / len(percents), 1) if percents else None


def _server(server: Mapping[str, Any]) -> dict[str, Any]:
    numbers = ("cpu_percent", "robots", "requests", "queue", "queue_ms", "in_flight", "pid", "warming")
    return {
        "name": printable(str(server.get("name", ""))),
        "state": printable(str(server.get("state", ""))),
        **{name: server.get(name) for name in numbers},
    }


def _data_server(server: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": printable(str(server.get("name", ""))),
        "state": "runs" if server.get("running") else "gone",
    }


def _age_s(pid: Any) -> float | None:
    """Return the time since the start of the process *pid*, in seconds; None if there is no such process."""
    mark = mark_of(pid) if isinstance(pid, int) else None
    if mark is None:
        return None
    uptime_s = float(Path("/proc/uptime").read_text(encoding="ascii").split()[0])
    return round(uptime_s - int(mark.began.partition("@")[0]) / os.sysconf("SC_CLK_TCK"), 1)


def _mappings_in(value: Any) -> list[Mapping[str, Any]]:
    if isinstance(value, Mapping):
        return [value]
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list | tuple) else []
