"""The public port leads to the robots' WebSocket and to large data; all else is on loopback or in a file."""

from __future__ import annotations

import asyncio
import stat
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.config import PlatformSettings
from rse_pf.local.balancer.envoy_config import ADMIN_SOCKET
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.state import read_state

pytestmark = pytest.mark.system

OURS_AND_NOT_PUBLIC = (
    "/", "/readyz", "/data/readyz", "/data//readyz", "/healthz/",
    "/healthz/../metrics", "/metrics", "/status", "/drain", "/move", "/ready", "/listeners", "/clusters",
    "/config_dump", "/quitquitquit", "/stats", "/ws/", "/ws/..", "/ws/../metrics", "//metrics",
    "/ws%2f..%2fmetrics", "/%2e%2e/metrics", "/datax", "/.env", "/server-status", "/admin",
)  # fmt: skip
HEALTH_PAGES = (("GET", "/healthz"), ("GET", "/readyz"))
PAGES_WITH_TOKEN = (
    ("GET", "/metrics"), ("GET", "/status"), ("POST", "/drain?wait=0"), ("POST", "/move?robots=1"),
    ("GET", "/drain"), ("HEAD", "/metrics"), ("GET", "//metrics"),
    ("GET", "/readyz/../status"), ("GET", "/elsewhere"),
)  # fmt: skip
LISTENING = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")


def asked(port: int, path: str, method: str = "GET", authorization: str = "") -> tuple[int, bytes]:
    headers = {"Authorization": authorization} if authorization else {}
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", method=method, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def health_of(port: int) -> tuple[int, bytes, set[str], list[str]]:
    """Return the answer of the health page, and the Server header of the other answers."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=10) as answer:
        found = answer.status, answer.read(), {name.lower() for name in answer.headers}
    named = []
    for path in ("/", "/ws", "/data/v1/objects", "/data/readyz"):
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=10).close()
        except urllib.error.HTTPError as error:
            with error:
                named += [
                    name for name in error.headers if name.lower() == "server" or "envoy" in name.lower()
                ]
    return *found, named


def status_of(port: int, path: str, method: str = "GET", authorization: str = "") -> int:
    return asked(port, path, method, authorization)[0]


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


async def test_the_public_port_has_three_paths_and_nothing_else_listens_publicly(tmp_path: Path) -> None:
    async with LocalPlatform(PlatformSettings(), state=tmp_path / "p", port=0, servers=1) as cloud:
        port = cloud.load_balancer.port
        statuses = {
            f"{method} {path}": await asyncio.to_thread(status_of, port, path, method)
            for path in OURS_AND_NOT_PUBLIC
            for method in ("GET", "POST")
        }
        robots = await asyncio.to_thread(status_of, port, "/ws")
        marks = [*cloud.backend_servers.marks.values(), cloud.load_balancer.process.mark]
        addresses = listening([mark.pid for mark in marks if mark is not None])
        mode = stat.S_IMODE(next((tmp_path / "p").rglob(ADMIN_SOCKET)).stat().st_mode)
        health = await asyncio.to_thread(health_of, port)

    assert {path: status for path, status in statuses.items() if status not in (400, 404)} == {}
    assert robots in (400, 401, 403, 426), "the WebSocket's path is there, and wants a handshake"
    assert len(addresses) >= 3
    assert all(address in LOOPBACK for address in addresses)
    assert mode == 0o600
    status, body, headers, named = health
    assert (status, body) == (200, b'{"status":"ok"}')
    assert headers <= {"content-type", "content-length", "date", "connection"}, "names nothing"
    assert named == []


async def test_a_control_port_answers_health_to_all_and_the_rest_only_with_its_token(tmp_path: Path) -> None:
    folder = tmp_path / "p"

    def probe(port: int) -> tuple[list[int], list[int], set[bytes], list[int], bytes]:
        token = read_control_token(folder / "control.token")
        wrong = ("", "Bearer", token, f"Basic {token}", bearer(token[:-1]), bearer("0" * 64))
        told = [asked(port, path, method, each) for method, path in PAGES_WITH_TOKEN for each in wrong]
        bodies = {body for status, body in told if body}
        health = [status_of(port, path, method) for method, path in HEALTH_PAGES]
        carried = [status_of(port, path, "GET", bearer(token)) for path in ("/metrics", "/status")]
        carried.append(status_of(port, "/move?robots=1", "POST", bearer(token)))
        page = asked(port, "/metrics", "GET", bearer(token))[1]
        carried.append(status_of(port, "/drain?wait=60", "POST", bearer(token)))
        return [status for status, _ in told], health, bodies, carried, page

    async with LocalPlatform(PlatformSettings(), state=folder, port=0, servers=1) as cloud:
        (server,) = cloud.servers
        status_port = getattr(read_state(folder), "status_port", 0)
        unasked = await asyncio.to_thread(status_of, status_port, "/status")
        mode = stat.S_IMODE((folder / "control.token").stat().st_mode)
        refused, health, bodies, carried, page = await asyncio.to_thread(probe, server.control_port)

    assert set(refused) == {401}
    assert bodies == {b'{"code": "unauthorized"}\n'}
    assert health == [200, 200]
    assert carried == [200, 200, 202, 202]
    assert f"control_refused {len(refused)}".encode() in page.replace(b".0", b"")
    assert unasked == 401
    assert mode == 0o600
    assert not (folder / "control.token").exists(), "the token goes with the platform"
