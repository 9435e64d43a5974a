"""`rse-pf robot` and `rse-pf token revoke` with --cloud: from the command by the bucket to a server."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import websockets

from rse_pf.auth.robot_key import RobotKey
from rse_pf.auth.trust_store import AccessControlStore, TrustStore
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.cli.main import main
from rse_pf.config import AuthSettings
from rse_pf.errors import Unauthorized
from rse_pf.wire import SUBPROTOCOLS
from rse_pf.wire.server_session import CLOSE_REVOKED
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context
from tests.kit.guarded_server import GuardedServer

Capture = pytest.CaptureFixture[str]
SETTINGS = AuthSettings()
CLOSED_WITHIN_S = 2.0
"""What docs/security.md promises (T3)."""


class Done(Exception):
    """Ends an agent's thread, which would run for ever."""


def agent_of(s3: Any, folder: Path) -> Agent:
    """Return the agent of an instance whose server reads *folder*."""
    machine = FakeMachine()
    clients = {"autoscaling": FakeScaling(machine)}
    return Agent(agent_context(machine, folder, clients=clients, artifacts=S3Store(s3, "artifacts")))


@contextlib.contextmanager
def watching(agent: Agent) -> Iterator[None]:
    """Let the agent fetch roster and deny list periodically, as `main` does."""
    stop = threading.Event()

    def sleep(seconds: float) -> None:
        if stop.wait(seconds):
            raise Done

    def watch() -> None:
        with contextlib.suppress(Done):
            agent.repeat("access-control", sleep)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(30)
        assert not thread.is_alive()


def output_of(capsys: Capture, *words: str) -> str:
    assert main(list(words)) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def enrol(capsys: Capture, name: str) -> RobotKey:
    """Make a robot's key, enrol it in the cloud, and return the robot's side."""
    Path(f"{name}.json").write_text(output_of(capsys, "robot", "keygen", "--out", f"{name}.key"))
    output_of(capsys, "robot", "enrol", name, "--public-key", f"{name}.json", "--cloud")
    return RobotKey(f"{name}.key", name)


def listed(capsys: Capture) -> dict[str, str]:
    rows = json.loads(output_of(capsys, "robot", "list", "--json", "--cloud"))
    return {row["robot"]: row["state"] for row in rows}


def test_robots_of_a_cloud_are_enrolled_listed_disabled_enabled_and_removed(
    capsys: Capture, cloud: Any
) -> None:
    output_of(capsys, "token", "init", "--cloud")
    for name in ("robot-1", "robot-2"):
        enrol(capsys, name)
    assert listed(capsys) == {"robot-1": "enrolled", "robot-2": "enrolled"}

    output_of(capsys, "robot", "disable", "robot-1", "--cloud")
    assert listed(capsys) == {"robot-1": "disabled", "robot-2": "enrolled"}
    output_of(capsys, "robot", "enable", "robot-1", "--cloud")
    output_of(capsys, "robot", "remove", "robot-2", "--cloud")

    assert listed(capsys) == {"robot-1": "enrolled"}
    room = AccessControlStore(S3Store(cloud, "artifacts"))
    assert [each.robot for each in room.roster().robots] == ["robot-1"]
    assert main(["robot", "remove", "robot-2", "--cloud"]) == 2
    assert "is not enrolled" in capsys.readouterr().err


def test_concurrent_changes_of_two_operators_are_both_kept(
    capsys: Capture, cloud: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one disables a robot between this command's read and its write."""
    output_of(capsys, "token", "init", "--cloud")
    other, swap = AccessControlStore(S3Store(cloud, "artifacts")), S3Store.compare_and_swap
    waiting = [lambda: other.change_deny_list(lambda d: d.with_robot("default", "robot-2", 1.0))]

    def late(self: S3Store, name: str, expected: bytes | None, data: bytes) -> None:
        if waiting:
            waiting.pop()()
        swap(self, name, expected, data)

    monkeypatch.setattr(S3Store, "compare_and_swap", late)
    output_of(capsys, "robot", "disable", "robot-1", "--not-enrolled", "--cloud")

    assert {each.robot for each in other.deny_list().disabled} == {"robot-1", "robot-2"}


def problem_of(trust: TrustStore, token: str) -> str:
    """Return why a server with *trust* refuses *token*; empty if it accepts it."""
    from rse_pf.auth.tokens import token_problem, verify_token

    assert trust.keys is not None
    try:
        verify_token(token, keys=trust.keys, now=time.time(), settings=SETTINGS)
    except Unauthorized as error:
        return token_problem(error)
    return ""


def test_one_fetch_of_the_agent_and_one_refresh_of_the_server_apply_a_change(
    capsys: Capture, cloud: Any, tmp_path: Path
) -> None:
    output_of(capsys, "token", "init", "--cloud")
    key = enrol(capsys, "robot-1")
    (tmp_path / "machine").mkdir()
    agent, trust = agent_of(cloud, tmp_path / "machine"), TrustStore(tmp_path / "machine" / "keys.json")
    tokens = [asyncio.run(key.token()), output_of(capsys, "token", "issue", "robot-3", "--cloud").strip()]
    tokens.append(output_of(capsys, "token", "issue", "robot-2", "--cloud").strip())

    def known() -> list[str]:
        agent.run("keys")
        agent.run("access-control")
        trust.refresh()
        assert trust.problem == ""
        return [problem_of(trust, token) for token in tokens]

    assert known() == ["", "", ""]
    output_of(capsys, "token", "revoke", tokens[1], "--cloud")
    assert known() == ["", "revoked", ""]
    output_of(capsys, "token", "revoke", "--all-of", "robot-2", "--not-enrolled", "--cloud")
    assert known() == ["", "revoked", "issued-too-early"]
    output_of(capsys, "robot", "disable", "robot-1", "--cloud")
    assert known() == ["disabled", "revoked", "issued-too-early"]
    output_of(capsys, "robot", "enable", "robot-1", "--cloud")
    output_of(capsys, "robot", "remove", "robot-1", "--cloud")
    assert known() == ["unknown-key", "revoked", "issued-too-early"]


@pytest.mark.system
@pytest.mark.parametrize(
    "how",
    [
        "disable",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("token-revoke", "all-of", "remove")),
    ],
)
def test_a_live_socket_ends_within_two_seconds_of_the_command(
    how: str, capsys: Capture, cloud: Any, tmp_path: Path
) -> None:
    output_of(capsys, "token", "init", "--cloud")
    key = enrol(capsys, "robot-1")
    (tmp_path / "machine").mkdir()
    server, agent = GuardedServer(tmp_path / "machine", workers=1), agent_of(cloud, tmp_path / "machine")
    agent.run("keys")
    agent.run("access-control")
    token = asyncio.run(key.token())
    if how == "all-of":  # in whole seconds: only tokens of an earlier second are revoked
        token = output_of(capsys, "token", "issue", "robot-1", "--cloud").strip()
    other = output_of(capsys, "token", "issue", "robot-2", "--cloud").strip()
    words: dict[str, list[str]] = {
        "token-revoke": ["token", "revoke", token], "all-of": ["token", "revoke", "--all-of", "robot-1"],
        "disable": ["robot", "disable", "robot-1"], "remove": ["robot", "remove", "robot-1"],
    }  # fmt: skip

    with server, watching(agent):
        closed_s = asyncio.run(
            _closed_after(server, token, other, lambda: output_of(capsys, *words[how], "--cloud"))
        )

    print(f"{how}: closed {closed_s:.2f} s after the command; load {os.getloadavg()[0]:.1f}")
    assert closed_s < CLOSED_WITHIN_S


async def _closed_after(server: GuardedServer, token: str, other: str, act: Callable[[], str]) -> float:
    """Return how long after *act* the socket of *token* ended; that of *other* must stay open."""
    sockets = [
        await websockets.connect(
            server.url, subprotocols=[SUBPROTOCOLS["bin"]], compression=None, ping_interval=None,  # type: ignore[list-item]
            additional_headers={"Authorization": f"Bearer {one}"}, open_timeout=30, close_timeout=1,
        )
        for one in (token, other)
    ]  # fmt: skip
    try:
        await asyncio.to_thread(act)
        done_s = time.monotonic()
        await asyncio.wait_for(sockets[0].wait_closed(), 30)
        closed_s = time.monotonic() - done_s
        assert sockets[0].close_code == CLOSE_REVOKED
        assert await asyncio.wait_for(server.handshake(f"Bearer {token}".encode()), 30) != (101, b"")
        await asyncio.wait_for(await sockets[1].ping(), 30)
        return closed_s
    finally:
        for each in sockets:
            each.transport.abort()
