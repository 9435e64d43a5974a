"""The audit log of real processes: servers, the control plane, an operator's commands; kill -9 too."""

from __future__ import annotations

import asyncio
import functools
import json
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import audit_folder, log_files, log_names, read_entries
from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.cli.main import main
from rse_pf.config import AuthSettings, PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

SOON_S = 20.0
PAUSE_S = 0.02


def awaited(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Return a test that runs the coroutine *test*, with its fixtures."""

    @functools.wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(test(**fixtures))

    return run


def entries(folder: Path, who: str) -> list[Entry]:
    return [entry for path in log_files(folder, who) for entry in read_entries(path)]


async def until(found: Callable[[], bool], what: Callable[[], object]) -> None:
    """Wait until *found*, which files tell and no event does."""
    end = time.monotonic() + SOON_S
    while not found():
        assert time.monotonic() < end, what()
        await asyncio.sleep(PAUSE_S)


@awaited
async def test_a_server_records_accepted_and_refused_robots_and_no_token(tmp_path: Path):
    with GuardedServer(tmp_path) as server:
        audit, good = tmp_path / "audit", server.token("robot-1")
        assert (await server.handshake(b"Bearer " + good.encode()))[0] == 101
        assert (await server.handshake(b"Bearer " + good[:-4].encode() + b"AAAA"))[0] == 401
        server.access.change_deny_list(lambda denied: denied.with_robot("default", "robot-1", time.time()))

        def tokens() -> list[str]:
            return [entry.action for entry in entries(audit, "guarded") if entry.action.startswith("auth")]

        await until(lambda: len(tokens()) >= 2, tokens)
        text = (audit / "guarded.jsonl").read_text()
        await until(lambda: '"refused"' in server.log, lambda: server.log)
        log = server.log

    written = {entry.action: entry for entry in entries(audit, "guarded")}
    assert next(iter(written)) == "server.ready"
    # Two workers judged them, so either may be written first.
    accepted, refused = written["auth.accepted"], written["auth.refused"]
    assert (accepted.action, accepted.subject, accepted.detail["token"]) == (
        "auth.accepted",
        "robot-1",
        "t-1",
    )
    assert accepted.detail["source"] == "127.0.0.1"
    assert (refused.action, refused.detail["claimed_robot"]) == ("auth.refused", "robot-1")
    lines = [json.loads(line) for line in log.splitlines() if '"refused"' in line]
    assert [(line["source"], line["claimed_robot"]) for line in lines] == [("127.0.0.1", "robot-1")]
    assert good not in text
    assert good.split(".")[1] not in text


@awaited
async def test_a_refused_robot_with_a_key_of_its_own_is_named_with_its_tenant(tmp_path: Path):
    key = SigningKey.of_robot(b"r" * 32)
    robot = EnrolledRobot(robot="robot-1", tenant="acme", x=public_key_of(key.public_json()))
    token = key.issue("robot-1", now=time.time(), token_id="t-1", settings=AuthSettings())
    server = GuardedServer(tmp_path)
    server.access.change_roster(lambda roster: roster.enrolled(robot))
    server.access.change_deny_list(lambda denied: denied.with_robot("acme", "robot-1", time.time()))

    def refusals() -> list[Entry]:
        return [entry for entry in entries(tmp_path / "audit", "guarded") if entry.action == "auth.refused"]

    with server:
        assert (await server.handshake(b"Bearer " + token.encode()))[0] == 401
        await until(lambda: len(refusals()) > 0, refusals)

    (refused,) = refusals()
    assert refused.detail["reason"] == "disabled"
    claimed = [refused.detail[f"claimed_{name}"] for name in ("robot", "tenant", "key")]
    assert claimed == ["robot-1", "acme", robot.key_id]


@awaited
async def test_the_log_of_a_server_goes_on_over_kills(tmp_path: Path):
    with GuardedServer(tmp_path) as server:
        for number in range(2):
            if number:
                server.restart()
            authorization = b"Bearer " + server.token(f"robot-{number}").encode()
            assert (await server.handshake(authorization))[0] == 101
            await until(
                lambda wanted=number + 1: sum(  # type: ignore[misc]
                    entry.action == "auth.accepted" for entry in entries(tmp_path / "audit", "guarded")
                ) >= wanted,
                lambda: entries(tmp_path / "audit", "guarded"),
            )  # fmt: skip

    actions = [entry.action for entry in entries(tmp_path / "audit", "guarded")]
    assert (actions.count("server.ready"), actions.count("auth.accepted")) == (2, 2)


@awaited
async def test_a_platform_records_its_actions_its_robots_and_its_operator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    state = tmp_path / "rse-pf" / "audited"
    audit = audit_folder(state)
    async with LocalPlatform(PlatformSettings(), state=state, servers=1, port=0, data=True) as cloud:
        from client_sdk import connect

        async with connect(cloud.url, token=cloud.issue_token("robot-1")):
            pass
        words = ["robot", "disable", "robot-7", "--not-enrolled", "--name", "audited"]
        assert await asyncio.to_thread(main, words) == 0
        (server,) = [who for who in log_names(audit) if who.startswith("server-")]

    assert {entry.subject for entry in entries(audit, server) if entry.action == "auth.accepted"} == {
        "robot-1"
    }
    deeds = {entry.action for entry in entries(audit, "control-plane")}
    assert {"platform.platform-ready", "platform.server-ready", "platform.over"} <= deeds
    capsys.readouterr()
    assert main(["audit", "show", "--name", "audited", "--only", "robot.disabled", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["subject"] == "robot-7"
