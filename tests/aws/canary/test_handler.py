"""The canary sees what a robot sees: a right pose, or why there is none."""

from __future__ import annotations

import asyncio
import functools
import json
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.aws.canary import handler as canary
from rse_pf.aws.canary.handler import ask_known_pose, read_key
from rse_pf.aws.clients import make_client
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, ConnectError, Expired, InternalError, UsageError
from rse_pf.service import Registry
from rse_pf.services import pnp
from tests.kit.fake_platform import FakePlatform

SETTINGS = PlatformSettings()
TRACE = "0af7651916cd43dd8448eb211c80319c"


def registry(change: Callable[[Any], Any] = lambda reply: reply) -> Registry:
    """Return the PnP service; *change* makes its replies wrong."""
    made, wrong = Registry(), Registry()
    pnp.register(made, SETTINGS.pnp)
    (service,) = list(made)

    @wrong.service("pnp")
    def solve(request: pnp.PnpRequest) -> pnp.PnpReply:
        return change(service.function(request))

    return wrong


def in_a_loop(test: Callable[..., Any]) -> Callable[..., None]:
    """Run a test that is a coroutine, with a time limit."""

    @functools.wraps(test)
    def run(*args: Any, **named: Any) -> None:
        asyncio.run(asyncio.wait_for(test(*args, **named), 30.0))

    return run


async def ask(platform: FakePlatform, token: str = "t") -> dict[str, Any]:
    return await asyncio.to_thread(
        ask_known_pose, platform.url, token, SETTINGS, trace=TRACE, clock=time.monotonic
    )


@in_a_loop
async def test_it_gets_a_right_pose_and_sends_its_token_and_its_trace() -> None:
    async with FakePlatform(registry=registry()) as platform:
        told = await ask(platform, "the-token")

        assert (told["server"], told["error"] < 0.01) == ("server-a", True)
        assert platform.tokens_seen == ["the-token"]
        assert [each.trace for each in platform.sockets[0].commands] == [TRACE]


@in_a_loop
async def test_a_wrong_pose_is_a_failure() -> None:
    def moved(reply: Any) -> Any:
        return msgspec.structs.replace(reply, T_camera_world=np.asarray(reply.T_camera_world) + 0.5)

    async with FakePlatform(registry=registry(moved)) as platform:
        with pytest.raises(InternalError, match=r"the pose of server-a is wrong by 0\.5"):
            await ask(platform)


@in_a_loop
async def test_a_server_that_leaves_is_a_failure_and_not_a_wait() -> None:
    async with FakePlatform(registry=registry()) as platform:

        async def leave(robot: Any, command: Any) -> None:
            robot.cut()

        platform.on_command = leave

        with pytest.raises(ConnectError, match="left"):
            await ask(platform)


@in_a_loop
async def test_a_redirect_is_a_failure_because_robots_do_not_follow_it() -> None:
    async with FakePlatform(registry=registry()) as platform:

        async def redirect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            head = f"HTTP/1.1 302 Found\r\nLocation: {platform.url}\r\nContent-Length: 0\r\n\r\n"
            writer.write(head.encode())
            writer.close()

        server = await asyncio.start_server(redirect, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(ConnectError, match="redirect"):
            await asyncio.to_thread(
                ask_known_pose, f"ws://127.0.0.1:{port}/ws", "t", SETTINGS, trace=TRACE, clock=time.monotonic
            )
        server.close()

        assert platform.tokens_seen == []


@in_a_loop
async def test_a_server_that_does_not_answer_the_command_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canary, "_TIMEOUT_S", 0.5)
    async with FakePlatform(registry=registry()) as platform:

        async def drop(robot: Any, command: Any) -> None:
            pass

        platform.on_command = drop

        with pytest.raises(Expired, match="no answer within"):
            await ask(platform)


@pytest.fixture
def secret(monkeypatch: pytest.MonkeyPatch) -> Any:
    moto = pytest.importorskip("moto", reason="run make setup")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    with moto.mock_aws():
        client = make_client("secretsmanager", SETTINGS.cloud.region)
        client.create_secret(Name="canary", SecretString="made by CloudFormation")
        yield client


def test_the_key_comes_from_its_secret(secret: Any) -> None:
    key = SigningKey.of_robot(b"c" * 32)
    with pytest.raises(UsageError, match="not a signing key"):
        read_key("canary", SETTINGS.cloud.region)
    with pytest.raises(ConfigurationError, match="ResourceNotFound"):
        read_key("nothing", SETTINGS.cloud.region)

    secret.put_secret_value(SecretId="canary", SecretString=key.to_json())

    assert read_key("canary", SETTINGS.cloud.region).key_id == key.key_id


@in_a_loop
async def test_the_handler_logs_one_line_and_fails_so_that_lambda_counts_it(
    secret: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    document = {"context": {"rse-pf": SETTINGS.to_dict()}}
    (tmp_path / "settings.json").write_text(json.dumps(document), encoding="utf-8")
    monkeypatch.setattr(canary, "_ROOT", tmp_path)
    secret.put_secret_value(SecretId="canary", SecretString=SigningKey.of_robot(b"c" * 32).to_json())
    async with FakePlatform(registry=registry()) as platform:
        for name, value in (("SECRET", "canary"), ("ROBOT", "canary"), ("URL", platform.url)):
            monkeypatch.setenv(f"RSE_PF_CANARY_{name}", value)

        await asyncio.to_thread(canary.handler, {}, None)
        platform.refusals = [(503, 1)]
        with pytest.raises(ConnectError):
            await asyncio.to_thread(canary.handler, {}, None)

    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["event"] for line in lines] == ["canary-solved", "canary-failed"]
    assert all(len(line["trace"]) == 32 for line in lines)
    assert platform.tokens_seen[0] not in str(lines)
