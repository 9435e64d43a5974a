"""T25: robots of one name in several tenants, and a name that was enrolled again, are different robots."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.identity import object_name
from rse_pf.storage.object_store import DirectoryStore, digest_of
from rse_pf.wire import Command, Failure, Result
from tests.kit import tenants
from tests.kit.attacks import AttackTarget
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

NARROWED_S = 2.0
TENANT, NAME = "acme", "robot-9"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("tenants")
    tenants.prepare(made)
    return made


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[GuardedServer]:
    """One worker, so that robots of all tenants share a process."""
    with GuardedServer(folder, workers=1, **tenants.settings_in(folder)) as server:
        yield server


class EnrolledRobotSocket:
    """An enrolled robot: its key, its entry in the roster, and one socket."""

    def __init__(self, server: GuardedServer, seed: bytes) -> None:
        self._server = server
        self._key = SigningKey.of_robot(seed)
        self._sent = 0
        self._socket: Any = None
        self.entry = EnrolledRobot(robot=NAME, tenant=TENANT, x=public_key_of(self._key.public_json()))

    def enroll(self, *scopes: str) -> None:
        """Enroll it with these scopes; a robot that had the name loses it."""
        entry = EnrolledRobot(robot=NAME, tenant=TENANT, x=self.entry.x, scopes=scopes)
        self._server.access.change_roster(lambda roster: roster.enrolled(entry))

    async def connect(self) -> None:
        """Connect as soon as the server knows the key."""
        token = self._key.issue(NAME, now=time.time(), token_id="t", settings=self._server.settings.auth)
        end = time.monotonic() + tenants.ANSWER_S
        while self._socket is None:
            try:
                self._socket = await AttackTarget(self._server.url).enter(token, "bin")
            except ConnectionError:
                assert time.monotonic() < end, "the server never learnt of the robot"

    async def ask(self, service: str, payload: Any) -> Any:
        self._sent += 1
        self._socket.say(
            Command(id=self._sent, service=service, payload=payload, keep=True, deadline_ms=30e3)
        )
        return await asyncio.wait_for(self._socket.hear(), tenants.ANSWER_S)

    def end(self) -> None:
        self._socket.end()


def test_robots_of_one_name_share_nothing_in_three_tenants(server: GuardedServer, folder: Path):
    tokens = {tenant: server.token(tenants.NAME, tenant=tenant) for tenant in tenants.TENANTS}

    outcome = asyncio.run(tenants.interleave(server.url, tokens, 300, jobs=1))

    assert (outcome.shared, outcome.stale) == ([], 0)
    assert sum(outcome.commands.values()) >= 290
    assert outcome.codes["keeper ok"]
    assert outcome.codes["optimise ok"] == 3
    for area in ("states", "jobs", "objects"):
        found = tenants.owners(folder / "store", area)
        assert {f"{tenant}/{tenants.NAME}" for tenant in tenants.TENANTS} <= set(found)
    assert "" not in tenants.count_logged(server.log)


def test_each_robot_finds_its_own_state_again_after_a_restart(server: GuardedServer):
    tokens = {tenant: server.token(tenants.NAME, tenant=tenant) for tenant in tenants.TENANTS}
    asyncio.run(tenants.interleave(server.url, tokens, 100, jobs=0))

    server.restart()

    async def kept(tenant: str) -> str:
        socket = await AttackTarget(server.url).enter(server.token(tenants.NAME, tenant=tenant), "bin")
        try:
            socket.say(Command(id=1, service="keeper", payload={}, keep=True, deadline_ms=30e3))
            answer = await asyncio.wait_for(socket.hear(), tenants.ANSWER_S)
            assert isinstance(answer, Result)
            return str(answer.reply["kept"])
        finally:
            socket.end()

    for tenant in tenants.TENANTS:
        assert asyncio.run(kept(tenant)) == tenants.secret_of(tenant)


def test_narrowed_scopes_reach_an_open_connection_within_two_seconds(server: GuardedServer):
    async def narrowed_after_s() -> float:
        robot = EnrolledRobotSocket(server, b"n" * 32)
        robot.enroll("services:echo", "services:keeper")
        await robot.connect()
        try:
            assert isinstance(await robot.ask("keeper", {"keep": "mine"}), Result)
            robot.enroll("services:echo")
            began = time.monotonic()
            while not isinstance(answer := await robot.ask("keeper", {}), Failure):
                assert time.monotonic() - began < tenants.ANSWER_S
            took_s = time.monotonic() - began
            assert answer.code == "forbidden"
            assert isinstance(await robot.ask("echo", {"value": 1}), Result)
            return took_s
        finally:
            robot.end()

    assert asyncio.run(narrowed_after_s()) <= NARROWED_S


def test_a_name_that_is_enrolled_again_sees_nothing_of_the_robot_before(server: GuardedServer, folder: Path):
    data = b"an object of the robot before"
    before, after = EnrolledRobotSocket(server, b"1" * 32), EnrolledRobotSocket(server, b"2" * 32)
    DirectoryStore(folder / "store").put(object_name(before.entry.id, digest_of(data)), data)
    named = {
        "map": {"object": digest_of(data)}, "camera": {"fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0},
        "pixels": [], "descriptors": b"",
    }  # fmt: skip

    async def see(robot: EnrolledRobotSocket, keep: str) -> tuple[str, str]:
        robot.enroll()
        await robot.connect()
        try:
            kept = await robot.ask("keeper", {"keep": keep})
            return kept.reply["kept"], (await robot.ask("place", named)).code
        finally:
            robot.end()

    assert asyncio.run(see(before, "a secret")) == ("a secret", "bad-request")
    assert asyncio.run(see(after, "")) == ("", "not-found")
