"""The page for monitors outside: 503 while nobody serves robots, and never a word about the software."""

from __future__ import annotations

import asyncio
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer

pytestmark = pytest.mark.system

SOON_S = 30.0


def asked(port: int, path: str) -> tuple[int, list[str]]:
    """Return the status, and the headers that name software."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=SOON_S) as answer:
            status, headers = answer.status, answer.headers
    except urllib.error.HTTPError as error:
        with error:
            status, headers = error.code, error.headers
    return status, [name for name in headers if name.lower() == "server" or "envoy" in name.lower()]


def test_without_a_server_the_health_page_answers_that_robots_are_not_served(tmp_path: Path) -> None:
    async def run() -> dict[str, tuple[int, list[str]]]:
        balancer = EnvoyLoadBalancer(PlatformSettings(), folder=tmp_path, port=0)
        balancer.launch()
        try:
            await balancer.wait_live(SOON_S)
            paths = ("/healthz", "/ws", "/data/v1/objects", "/data/readyz", "/")
            return {path: await asyncio.to_thread(asked, balancer.port, path) for path in paths}
        finally:
            balancer.kill()

    told = asyncio.run(run())

    assert {path: status for path, (status, _) in told.items()} == {
        "/healthz": 503, "/ws": 503, "/data/v1/objects": 503, "/data/readyz": 404, "/": 404,
    }  # fmt: skip
    assert {path: named for path, (_, named) in told.items() if named} == {}
