"""The public port leads to the robots' WebSocket and to large data; all else is on loopback or in a file."""

from __future__ import annotations

import asyncio
import stat
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from rse_pf.local.cloud import LocalCloud
from rse_pf.local.envoy_config import ADMIN_SOCKET
from rse_pf.settings import PlatformSettings

pytestmark = pytest.mark.system

OURS_AND_NOT_PUBLIC = (
    "/", "/healthz", "/readyz", "/metrics", "/status", "/drain", "/move", "/ready", "/listeners", "/clusters",
    "/config_dump", "/quitquitquit", "/stats", "/ws/", "/ws/..", "/ws/../metrics", "//metrics",
    "/ws%2f..%2fmetrics", "/%2e%2e/metrics", "/datax", "/.env", "/server-status", "/admin",
)  # fmt: skip
LISTENING = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")


def status_of(port: int, path: str, method: str = "GET") -> int:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", method=method)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def listening(pids: list[int]) -> list[str]:
    """Return the addresses, as the kernel writes them, on which these processes listen for TCP."""
    sockets: set[str] = set()
    for pid in pids:
        for each in Path(f"/proc/{pid}/fd").iterdir():
            target = each.readlink().as_posix() if each.is_symlink() else ""
            if target.startswith("socket:["):
                sockets.add(target[8:-1])
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == LISTENING and words[9] in sockets:
                found.append(words[1].partition(":")[0])
    return found


def test_the_door_knows_two_paths_and_nothing_else_listens_to_the_world(tmp_path: Path) -> None:
    async def scan() -> tuple[dict[str, int], int, list[str], int]:
        async with LocalCloud(PlatformSettings(), state=tmp_path / "p", port=0, servers=1) as cloud:
            door = cloud.load_balancer.port
            statuses = {
                f"{method} {path}": await asyncio.to_thread(status_of, door, path, method)
                for path in OURS_AND_NOT_PUBLIC
                for method in ("GET", "POST")
            }
            robots = await asyncio.to_thread(status_of, door, "/ws")
            marks = [*cloud.backend_servers.marks.values(), cloud.load_balancer.mark]
            addresses = listening([mark.pid for mark in marks if mark is not None])
            mode = stat.S_IMODE(next((tmp_path / "p").rglob(ADMIN_SOCKET)).stat().st_mode)
            return statuses, robots, addresses, mode

    statuses, robots, addresses, mode = asyncio.run(scan())

    assert {path: status for path, status in statuses.items() if status not in (400, 404)} == {}
    assert robots in (400, 401, 403, 426), "the WebSocket's path is there, and wants a handshake"
    assert len(addresses) >= 3
    assert all(address in LOOPBACK for address in addresses)
    assert mode == 0o600
