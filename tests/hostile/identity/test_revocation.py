"""T2 to T4: a live socket ends with its token, with its revocation, and when a newer one takes its place."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
import websockets

from client_sdk import Robot, connect
from rse_pf.auth.robot_key import RobotKey, make_robot_key
from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.errors import Forbidden, Unauthorized
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Hello, Renew, Renewed, Result, make_codec
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_REVOKED, CLOSE_TOKEN_OVER
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

CODEC = make_codec("bin")
ANSWER_S = 30.0


class Socket:
    """One robot's socket, and when it ended how."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.token_s: float | None = None
        self.code: int | None = None
        self.ended_s = 0.0
        self._heard: asyncio.Queue[Any] = asyncio.Queue()
        self._reading = asyncio.create_task(self._read())

    async def hello(self) -> None:
        await self.socket.send(CODEC.encode(Hello()))
        self.token_s = (await self.hear()).token_s

    async def hear(self) -> Any:
        return await asyncio.wait_for(self._heard.get(), ANSWER_S)

    async def ask(self, message: Any) -> Any:
        await self.socket.send(CODEC.encode(message))
        return await self.hear()

    async def echo(self) -> bool:
        """Return whether a command is answered."""
        return isinstance(await self.ask(Command(id=1, service="echo", payload={"value": 1})), Result)

    async def end(self, within_s: float) -> int:
        """Return the close code as soon as the socket ended."""
        await asyncio.wait_for(asyncio.shield(self._reading), within_s)
        assert self.code is not None
        return self.code

    async def _read(self) -> None:
        try:
            while True:
                self._heard.put_nowait(CODEC.decode_from_server(await self.socket.recv(decode=False)))
        except websockets.ConnectionClosed:
            self.ended_s = time.monotonic()
            self.code = self.socket.close_code


@contextlib.asynccontextmanager
async def robots(server: GuardedServer, tokens: list[str]) -> AsyncIterator[list[Socket]]:
    """Open a socket for each token, say hello on each, and close what is left."""
    opened: list[Socket] = []
    try:
        for token in tokens:
            socket = Socket(await dial(server, token))
            opened.append(socket)
            await socket.hello()
        yield opened
    finally:
        for each in opened:
            each.socket.transport.abort()


async def dial(server: GuardedServer, token: str) -> Any:
    return await websockets.connect(
        server.url, subprotocols=[SUBPROTOCOLS["bin"]], compression=None, ping_interval=None,  # type: ignore[list-item]
        additional_headers={"Authorization": f"Bearer {token}"}, open_timeout=ANSWER_S, close_timeout=1,
    )  # fmt: skip


async def is_refused(server: GuardedServer, token: str) -> bool:
    return (await server.handshake(f"Bearer {token}".encode()))[0] == 401


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    session = {"max_commands_per_s": 0.0, "ping_timeout_s": 30.0}  # these robots send no pings
    with GuardedServer(tmp_path_factory.mktemp("guarded"), session=session) as server:
        yield server


async def revoke_some(server: GuardedServer, robot_count: int, revoked_count: int) -> None:
    """Revoke tokens, disable robots, and look at all of them before and after a restart of the server."""
    names = [f"fleet-{number}" for number in range(robot_count)]
    tokens = [server.token(name) for name in names]
    async with robots(server, tokens) as sockets:
        began, load = time.monotonic(), os.getloadavg()[0]
        gone = range(revoked_count)
        for number in gone:
            name, token_id = names[number], f"t-{server._issued - robot_count + number + 1}"
            if number % 2:
                server.access.change_deny_list(
                    lambda d, name=name: d.with_robot("default", name, time.time())
                )
            else:
                until_s = time.time() + 900
                server.access.change_deny_list(
                    lambda d, n=name, t=token_id, u=until_s: d.with_token("default", n, t, u)
                )
        told = time.monotonic()
        codes = [await sockets[number].end(30.0) for number in gone]
        latest_s = max(sockets[number].ended_s for number in gone) - began
        print(
            f"{revoked_count} of {robot_count} revoked in {told - began:.2f} s, the last one closed after "
            f"{latest_s:.2f} s; load {load:.1f}"
        )
        assert codes == [CLOSE_REVOKED] * revoked_count
        assert latest_s < 2.0
        assert [await is_refused(server, tokens[number]) for number in gone] == [True] * revoked_count
        stayed = sockets[revoked_count:]
        assert all([await socket.echo() for socket in stayed])
        assert [socket.code for socket in stayed] == [None] * len(stayed)

    server.restart()

    refused = [await is_refused(server, token) for token in tokens]
    assert refused == [number < revoked_count for number in range(robot_count)]
    assert '"defect"' not in server.log


def test_revoked_robots_are_closed_within_two_seconds_and_refused_after_a_restart(
    server: GuardedServer,
) -> None:
    asyncio.run(revoke_some(server, robot_count=6, revoked_count=2))


@pytest.mark.slow
def test_of_a_hundred_robots_the_ten_that_are_revoked_are_closed_and_no_other(tmp_path: Path) -> None:
    with GuardedServer(tmp_path, session={"max_commands_per_s": 0.0}) as fresh:
        asyncio.run(revoke_some(fresh, robot_count=100, revoked_count=10))


async def test_a_socket_ends_within_a_second_of_its_token_and_not_before(server: GuardedServer) -> None:
    async with robots(server, [server.token("short", ttl_s=3.0)]) as (socket,):
        assert socket.token_s is not None
        expected = time.monotonic() + socket.token_s
        assert await socket.end(30.0) == CLOSE_TOKEN_OVER
        late_s = socket.ended_s - expected
        print(f"closed {late_s * 1e3:+.0f} ms after the token's end; load {os.getloadavg()[0]:.1f}")
        assert -0.05 < late_s < 1.0


async def test_a_fresh_token_moves_the_end_of_the_socket_and_a_bad_one_does_not(
    server: GuardedServer,
) -> None:
    names = ["renews", "renews-2", "renews-3"]
    async with robots(server, [server.token(name, ttl_s=3.0) for name in names]) as (socket, *wrong):
        assert socket.token_s is not None
        first_end = time.monotonic() + socket.token_s
        for other, token in zip(wrong, ("x", server.token("another")), strict=True):
            refusal = await other.ask(Renew(token=token))
            assert isinstance(refusal, Failure)
            assert (refusal.id, refusal.code) == (None, "unauthorized")
        renewed = await socket.ask(Renew(token=server.token("renews", ttl_s=30.0)))
        assert isinstance(renewed, Renewed)
        assert 25.0 < renewed.token_s <= 30.0
        with pytest.raises(asyncio.TimeoutError):
            await socket.end(first_end + 1.1 - time.monotonic())
        assert await socket.echo()
        assert [other.code for other in wrong] == [CLOSE_TOKEN_OVER] * 2


async def test_revoking_the_fresh_token_ends_the_socket_that_was_renewed_with_it(
    server: GuardedServer,
) -> None:
    async with robots(server, [server.token("twice")]) as (socket,):
        assert isinstance(await socket.ask(Renew(token=server.token("twice"))), Renewed)
        fresh = f"t-{server._issued}"
        server.access.change_deny_list(lambda d: d.with_token("default", "twice", fresh, time.time() + 900))
        assert await socket.end(30.0) == CLOSE_REVOKED


@pytest.mark.slow
async def test_a_session_outlives_its_tokens_without_a_gap_and_ends_when_its_robot_is_disabled(
    server: GuardedServer, tmp_path: Path
) -> None:
    public = make_robot_key(tmp_path / "robot.key")
    enrolled = EnrolledRobot(robot="own-key", x=public_key_of(public), scopes=("services:echo",))
    server.access.change_roster(lambda roster: roster.enrolled(enrolled))
    short = server.settings.replace(auth={"token_ttl_s": 10}).auth
    key = RobotKey(tmp_path / "robot.key", "own-key", settings=short)
    tokens = 0

    async def fresh() -> str:
        nonlocal tokens
        tokens += 1
        return await key.token()

    await until(lambda: connects(server, fresh))
    async with connect(server.url, token=fresh) as robot:
        began = time.monotonic()
        await echo_on(robot, until_s=began + 12.0)
        assert robot.stats.reconnects == 0
        assert tokens >= 3
        with pytest.raises(Forbidden):
            await robot.call("pnp", {})
        server.access.change_deny_list(lambda d: d.with_robot("default", "own-key", time.time()))
        with pytest.raises(Unauthorized):
            await echo_on(robot, until_s=began + 60.0)


async def echo_on(robot: Robot, until_s: float) -> None:
    while time.monotonic() < until_s:
        await robot.call("echo", {"value": 1}, deadline_s=20.0)


async def connects(server: GuardedServer, token: Any) -> bool:
    return (await server.handshake(f"Bearer {await token()}".encode()))[0] == 101


async def until(holds: Any, within_s: float = 30.0) -> None:
    """Ask again and again until it holds."""
    end = time.monotonic() + within_s
    while not await holds():
        assert time.monotonic() < end


async def races(server: GuardedServer, count: int) -> None:
    """Let two sockets of one robot come at the same time, *count* times; the loser is told."""
    dearest = 0.0
    for number in range(count):
        tokens = [server.token(f"racer-{number}") for _ in range(2)]
        pair = [Socket(each) for each in await asyncio.gather(*(dial(server, token) for token in tokens))]
        await asyncio.gather(*(socket.hello() for socket in pair), return_exceptions=True)
        began = time.monotonic()
        done, _ = await asyncio.wait(
            [each._reading for each in pair], timeout=30, return_when="FIRST_COMPLETED"
        )
        assert len(done) == 1
        dearest = max(dearest, time.monotonic() - began)
        losers = [socket for socket in pair if socket.code is not None]
        (winner,) = [socket for socket in pair if socket.code is None]
        assert [loser.code for loser in losers] == [CLOSE_REPLACED]
        assert await winner.echo()
        winner.socket.transport.abort()
        await winner.end(30.0)
    print(
        f"{count} races: 1 live session each, the loser closed within {dearest * 1e3:.0f} ms of both Welcomes"
    )


def test_of_two_sockets_of_one_robot_one_lives(server: GuardedServer) -> None:
    asyncio.run(races(server, 20))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_of_a_thousand_races_leaves_one_live_session(server: GuardedServer) -> None:
    asyncio.run(races(server, 1000))


async def connect_on(server: GuardedServer, name: str, over: asyncio.Event) -> float:
    """Connect again and again with fresh tokens; return when the last socket ended, refused after *over*."""
    ended_s = 0.0
    while True:
        is_over = over.is_set()
        try:
            socket = Socket(await dial(server, server.token(name)))
        except websockets.InvalidHandshake as error:  # also where a newer socket ended it before the answer
            if is_over and isinstance(error, websockets.InvalidStatus):
                return ended_s
            continue
        with contextlib.suppress(websockets.ConnectionClosed):
            await socket.socket.send(CODEC.encode(Hello()))
        await socket.end(30.0)
        ended_s = socket.ended_s


async def revoke_races(server: GuardedServer, count: int) -> float:
    """Disable robots while each connects all the time; return the longest life after that, in seconds."""
    longest_s = 0.0
    for number in range(count):
        name, over = f"storm-{number}", asyncio.Event()
        connecting = [asyncio.create_task(connect_on(server, name, over)) for _ in range(4)]
        await asyncio.sleep(0.01 * (number % 7))  # the moment is what is tried
        server.access.change_deny_list(lambda d, name=name: d.with_robot("default", name, time.time()))
        disabled_s = time.monotonic()
        assert await until_refused(server, name) < 30.0
        over.set()
        longest_s = max(longest_s, max(await asyncio.gather(*connecting)) - disabled_s)
    return longest_s


async def until_refused(server: GuardedServer, name: str) -> float:
    """Return how long a fresh token of *name* was accepted, in seconds."""
    began = time.monotonic()
    while (await server.handshake(f"Bearer {server.token(name)}".encode()))[0] == 101:
        pass
    return time.monotonic() - began


def test_a_robot_that_connects_while_it_is_disabled_is_out_within_two_seconds(server: GuardedServer) -> None:
    assert asyncio.run(revoke_races(server, 3)) < 2.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_of_a_hundred_races_of_connecting_and_disabling_the_robot_wins_none(server: GuardedServer) -> None:
    assert asyncio.run(revoke_races(server, 100)) < 2.0


def test_keys_that_are_rotated_out_end_their_sockets_and_new_ones_need_no_restart(
    server: GuardedServer,
) -> None:
    old = (server.folder / "keys.json").read_text()
    key = SigningKey.from_seed(b"n" * 32, "guard-2")

    async def run() -> None:
        async with robots(server, [server.token("rotated")]) as (socket,):
            replace(server.folder / "keys.json", key.key_set().to_json())
            assert await socket.end(30.0) == CLOSE_REVOKED
            fresh = key.issue("rotated", now=time.time(), token_id="n", settings=server.settings.auth)
            assert (await server.handshake(f"Bearer {fresh}".encode()))[0] == 101

    try:
        asyncio.run(run())
    finally:
        replace(server.folder / "keys.json", old)
        asyncio.run(until(lambda: connects(server, lambda: _value(server.token("back")))))


async def _value(text: str) -> str:
    return text


def replace(file: Path, text: str) -> None:
    temporary = file.with_suffix(".new")
    temporary.write_text(text)
    temporary.replace(file)
