"""What plays firewall, load balancer and Lambda on one machine, and the real robot before it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import client_sdk
from lambda_pnp.local_front import LocalFront, answering_of, main
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import BURST_PATH
from rse_pf.pnp.problems import make_problem
from tests.kit.fake_platform import FakePlatform
from tests.kit.http_service import http_service

KEY = SigningKey.from_seed(bytes(range(32)), "key-1")
SETTINGS = PlatformSettings()


def token(robot: str = "robot-1") -> str:
    return KEY.issue(robot, now=time.time(), token_id="t", settings=SETTINGS.auth)


@asynccontextmanager
async def a_front(folder: Path, *, most: int = 4) -> AsyncIterator[tuple[LocalFront, str]]:
    """Yield a front that serves, and the address of its function."""
    (folder / "keys.json").write_text(KEY.key_set().to_json(), encoding="utf-8")
    front = LocalFront(answering_of(SETTINGS, folder), most=most)
    async with http_service(front) as port:
        yield front, f"http://127.0.0.1:{port}{BURST_PATH}"
    front.close()


async def said(url: str, request: bytes) -> int:
    """Return the status that a raw request gets."""
    host, _, port = url.removeprefix("http://").partition("/")[0].partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(request)
    head = await reader.readuntil(b"\r\n\r\n")
    writer.transport.abort()
    return int(head.split()[1])


@pytest.mark.parametrize(
    ("request_line", "headers", "status"),
    [
        ("POST /burst HTTP/1.1", "", 401),
        ("POST /burst HTTP/1.1", "authorization: Bearer x\r\n", 401),
        ("POST /burst HTTP/1.1", "authorization: {token}\r\nauthorization: {token}\r\n", 400),
        ("POST /burst HTTP/1.1", "authorization: {token}\r\n", 400),
        ("GET /burst HTTP/1.1", "authorization: {token}\r\n", 404),
        ("POST /burst/x HTTP/1.1", "authorization: {token}\r\n", 404),
        ("POST /ws HTTP/1.1", "authorization: {token}\r\n", 404),
        ("POST /burst HTTP/1.1", "content-length: 2000000\r\n", 413),
        ("POST /burst HTTP/1.1", "content-length: x\r\n", 400),
        ("POST /burst HTTP/1.1", "transfer-encoding: chunked\r\n\r\n100001\r\n" + "x" * 0x100001, 413),
    ],
)
async def test_a_wrong_request_gets_the_status_that_aws_would_give(
    tmp_path: Path, request_line: str, headers: str, status: int
) -> None:
    async with a_front(tmp_path) as (_, url):
        told = headers.format(token=f"Bearer {token()}")
        assert await said(url, f"{request_line}\r\nhost: x\r\n{told}\r\n".encode()) == status


async def test_a_request_whose_client_leaves_starts_no_execution(tmp_path: Path) -> None:
    front = LocalFront(answering_of(SETTINGS, tmp_path), most=1)
    parts = iter(({"type": "http.request", "body": b"x", "more_body": True}, {"type": "http.disconnect"}))

    async def receive() -> Mapping[str, Any]:
        return next(parts)

    async def send(message: Mapping[str, Any]) -> None:
        pass

    headers = [(b"authorization", f"Bearer {token()}".encode())]
    await front({"method": "POST", "path": BURST_PATH, "headers": headers}, receive, send)

    assert front.executions == 0


async def test_more_than_the_reserved_executions_are_refused(tmp_path: Path) -> None:
    async with a_front(tmp_path, most=1) as (front, url):
        front._most = 0
        right = f"POST /burst HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {token()}\r\n\r\n".encode()
        assert await said(url, right) == 502
        assert (front.answered, front.refused) == (0, 1)


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
async def test_a_robot_gets_the_pose_of_the_function(tmp_path: Path, codec: str) -> None:
    problem = make_problem(seed=4)

    async with a_front(tmp_path) as (front, url):
        async with FakePlatform() as platform:
            platform.refusals = [(503, None)] * 1000
            robot = client_sdk.connect(
                platform.url, token=token(), random=Random(1), codec=codec, burst_url=url
            )
            async with robot:
                answer = await robot.solve_pnp(
                    problem.points_world, problem.pixels, problem.camera, deadline_s=10.0
                )
        assert (answer.source, answer.server, front.executions) == ("burst", "lambda", 1)
        np.testing.assert_allclose(answer.solution.T_camera_world, problem.T_camera_world, atol=0.05)


def test_it_does_not_start_without_a_platform(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["local_front", str(tmp_path / "nothing")])

    assert main() == 2
    assert "hint" in capsys.readouterr().err
