"""The load generator counts what a server did, in each codec, and ends whatever a server does."""

from __future__ import annotations

import asyncio
import contextlib
import http
import socket
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from benchmarks.server.load import (
    OUTCOMES,
    LoadPlan,
    LoadProcess,
    LoadReport,
    RobotGroup,
    compile_generator,
    hello_file,
    plan_of,
    read_samples,
    run_load,
    write_messages,
)
from rse_pf.config import SessionSettings
from rse_pf.errors import ConfigurationError
from rse_pf.experiments.load.payloads import make_payloads
from rse_pf.experiments.load.scenario import LoadScenario, read_scenario, write_scenario
from rse_pf.experiments.load.swarm import Swarm, SwarmResult
from rse_pf.wire import (
    SUBPROTOCOLS,
    Command,
    Failure,
    FromServer,
    Hello,
    Limits,
    Rate,
    Refused,
    Result,
    Welcome,
    make_codec,
)

pytestmark = pytest.mark.system

IDS = 8
FAILS, IS_SILENT, FAILS_WITHOUT_ID = 1, 2, 3
"""What the server does with the commands of these ids; it answers all others, and all with this payload:"""
ALL = "answer all"
LATER = "refuse all for a while"
TOGETHER, AT_ONCE = "refuse many at once", 10
PACED, PACED_PER_S = "answer all, and tell a rate", 20.0
READY_S = 10.0
STALL_S = 0.15


class ScriptedServer:
    """A server in a thread, which answers by the id of a command and counts what it did."""

    def __init__(self) -> None:
        self.port = 0
        self.outcomes: Counter[str] = Counter()
        self.sources: set[str] = set()
        self.tokens: set[str] = set()
        self.echoes = False
        self.commands: list[Command] = []
        self.capabilities: set[str] = set()
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._run(),))

    def __enter__(self) -> ScriptedServer:
        self._thread.start()
        assert self._ready.wait(READY_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(READY_S)
        self._loop.close()

    async def _run(self) -> None:
        names = [*SUBPROTOCOLS.values()]
        server: Server
        async with serve(
            self._talk, "127.0.0.1", 0, subprotocols=names, process_request=self._judge,  # type: ignore[arg-type]
            compression=None, close_timeout=0.1,
        ) as server:  # fmt: skip
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._ready.set()
            await self._stop.wait()

    def _judge(self, connection: ServerConnection, request: Request) -> Response | None:
        self.tokens.add(request.headers.get("authorization", ""))
        if request.path == "/full":
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "")
        return None

    async def _talk(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            await self._answer(connection)

    async def _answer(self, connection: ServerConnection) -> None:
        codec = make_codec({name: short for short, name in SUBPROTOCOLS.items()}[str(connection.subprotocol)])
        self.sources.add(connection.remote_address[0])

        refused: list[int] = []

        async def say(message: FromServer) -> None:
            data = codec.encode(message)
            await connection.send(data.decode() if codec.is_text else data)

        capabilities: set[str] = set()
        async for data in connection:
            message = codec.decode_from_robot(data.encode() if isinstance(data, str) else data)
            if isinstance(message, Hello):
                limits = Limits(max_message_bytes=1 << 20, max_in_flight=64)
                capabilities = set(message.capabilities)
                await say(Welcome(server="s", session="x", robot="r", protocol=1, limits=limits, clock_s=0.0))
                if connection.request is not None and connection.request.path == "/closes":
                    await connection.close(4429)
                continue
            if not isinstance(message, Command):
                continue  # a ping of the SDK, which does not miss the answer so soon
            self.commands.append(message)
            if self.echoes:
                await say(Result(id=message.id, reply=message.payload))
                continue
            if message.payload == "stall" and not self.outcomes["stalled"]:
                self.outcomes["stalled"] += 1
                await asyncio.sleep(STALL_S)  # the defect that the test looks for
            if message.payload == LATER:
                wait_ms = 1e3 * READY_S
                text = "the server is behind with its work"
                await say(Failure(id=message.id, code="busy", message=text, retry_after_ms=wait_ms))
            elif message.payload == TOGETHER:
                refused.append(message.id)
                if len(refused) == AT_ONCE:
                    await say(Refused(ids=refused, code="busy", message="later", retry_after_ms=1.0))
                    refused.clear()
            elif message.payload == PACED:
                self.capabilities |= capabilities
                await say(Rate(commands_per_s=PACED_PER_S, for_ms=1e4))
                await say(Result(id=message.id))
            elif message.payload == ALL:
                await say(Result(id=message.id))
            elif message.id == IS_SILENT:
                self.outcomes["lost"] += 1
            elif message.id in (FAILS, FAILS_WITHOUT_ID):
                self.outcomes["failed"] += 1
                await say(Failure(id=FAILS if message.id == FAILS else None, code="busy", message="later"))
            else:
                self.outcomes["ok"] += 1
                await say(Result(id=message.id, reply={"type": "failure", "id": 99}))


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The generator, compiled with all warnings as errors."""
    try:
        return compile_generator(tmp_path_factory.mktemp("load"))
    except ConfigurationError as error:
        if "needs a C compiler" in error.message:
            pytest.skip(error.message)
        raise


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as made:
        yield made


@pytest.fixture(autouse=True)
def _compiled_here(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.server.load.compile_generator", lambda: program)


def commands(folder: Path, codec_name: str, ids: int = IDS, payload: str = "") -> Path:
    codec = make_codec(codec_name)
    made = [codec.encode(Command(id=n, service="echo", payload=payload)) for n in range(ids)]
    return write_messages(folder / f"commands.{codec_name}", made)


def plan(server: ScriptedServer, folder: Path, codec: str, *groups: RobotGroup, **more: object) -> LoadPlan:
    return LoadPlan(
        port=server.port, groups=groups, codec=codec,
        **{"hello": hello_file(folder, codec), "warm_up_s": 0.0, "seconds": 0.2, "drain_s": 0.2, **more},  # type: ignore[arg-type]
    )  # fmt: skip


def open_loop(payload: Path, robots: int = 2, rate: float = 100.0, name: str = "robots") -> RobotGroup:
    return RobotGroup(name=name, robots=robots, mode="open", rate=rate, payload=payload)


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_counts_what_the_server_did_in_each_codec(server: ScriptedServer, tmp_path: Path, codec: str) -> None:
    samples = tmp_path / "samples"
    load = plan(server, tmp_path, codec, open_loop(commands(tmp_path, codec)), samples=samples)

    report = run_load(load)

    found = report.groups[0]
    counted = {"ok": found.ok, "failed": found.failed, "lost": found.lost}
    assert counted == dict(server.outcomes)
    assert report.codes == {"busy": found.failed}
    assert sum(counted.values()) == 40
    assert (found.unsent, report.unmatched, report.connected) == (0, 0, 2)
    assert found.latency_ms.n == found.ok + found.failed
    rows = read_samples(samples)
    assert {name: int(np.sum(rows["outcome"] == n)) for n, name in enumerate(OUTCOMES)} == counted | {
        "unsent": 0
    }


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_robots_that_obey_are_silent_as_long_as_a_failure_says(
    server: ScriptedServer, tmp_path: Path, codec: str
) -> None:
    group = open_loop(commands(tmp_path, codec, ids=64, payload=LATER))

    ignoring = run_load(plan(server, tmp_path, codec, group)).groups[0]
    obeying = run_load(plan(server, tmp_path, codec, group, obeys=True)).groups[0]

    assert (ignoring.failed, ignoring.unsent) == (40, 0)
    assert obeying.failed < 10
    assert obeying.failed + obeying.unsent == 40


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_each_command_that_a_message_ends_counts_as_failed(
    server: ScriptedServer, tmp_path: Path, codec: str
) -> None:
    group = open_loop(commands(tmp_path, codec, ids=300, payload=TOGETHER), robots=40)  # ids of three digits

    report = run_load(plan(server, tmp_path, codec, group))

    assert report.groups[0].failed == 800
    assert report.codes == {"busy": 800}
    assert report.unmatched == 0


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_robots_that_obey_keep_to_a_told_rate(server: ScriptedServer, tmp_path: Path, codec: str) -> None:
    group = open_loop(commands(tmp_path, codec, ids=64, payload=PACED))

    ignoring = run_load(plan(server, tmp_path, codec, group, seconds=0.5)).groups[0]
    assert not server.capabilities
    hello = hello_file(tmp_path, codec, obeys=True)
    obeying = run_load(plan(server, tmp_path, codec, group, seconds=0.5, obeys=True, hello=hello)).groups[0]

    assert (ignoring.ok, ignoring.unsent) == (100, 0)
    assert server.capabilities == {"refusals", "rate"}
    assert obeying.ok + obeying.unsent == 100
    assert 12 <= obeying.ok <= 2 * (2 + 0.5 * PACED_PER_S), (
        "of two robots, and one or two before they are told"
    )


def test_latency_counts_from_the_planned_time(server: ScriptedServer, tmp_path: Path) -> None:
    payload = commands(tmp_path, "bin", ids=64, payload="stall")

    report = run_load(plan(server, tmp_path, "bin", open_loop(payload, robots=1, rate=50.0)))

    latency = report.groups[0].latency_ms
    assert latency.max >= 1e3 * STALL_S
    assert latency.p50 >= 0.2 * 1e3 * STALL_S, "commands planned during the stall waited, too"


def test_a_closed_loop_sends_when_it_is_answered(server: ScriptedServer, tmp_path: Path) -> None:
    group = RobotGroup(name="one", robots=1, mode="closed", payload=commands(tmp_path, "bin", ids=1))

    report = run_load(plan(server, tmp_path, "bin", group))

    assert report.groups[0].is_clean
    assert report.groups[0].ok == server.outcomes["ok"]


def test_reports_groups_apart_and_uses_tokens_and_sources(server: ScriptedServer, tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    tokens.write_text("a\nb\nc\n")
    payload = commands(tmp_path, "bin", ids=64, payload=ALL)
    groups = (open_loop(payload, 2, 50.0, "slow"), open_loop(payload, 1, 200.0, "fast"))

    report = run_load(plan(server, tmp_path, "bin", *groups, tokens=tokens, sources=3))

    assert [(each.name, each.ok) for each in report.groups] == [("slow", 20), ("fast", 40)]
    assert report.group("fast").robots == 1
    assert server.tokens == {"Bearer a", "Bearer b", "Bearer c"}
    assert server.sources == {"127.0.0.1", "127.0.0.2", "127.0.0.3"}


def test_counts_refused_handshakes_and_close_codes(server: ScriptedServer, tmp_path: Path) -> None:
    group = open_loop(commands(tmp_path, "bin"), robots=3)

    refused = run_load(plan(server, tmp_path, "bin", group, path="/full"))
    closed = run_load(plan(server, tmp_path, "bin", group, path="/closes"))

    assert (refused.connected, refused.refused) == (0, {"503": 3})
    assert refused.groups[0].unsent == 60
    assert closed.closed == {"4429": 3}


def test_a_robot_that_was_closed_connects_again(server: ScriptedServer, tmp_path: Path) -> None:
    group = open_loop(commands(tmp_path, "bin"), robots=1)

    report = run_load(plan(server, tmp_path, "bin", group, path="/closes", reopen_s=0.02))

    assert report.closed["4429"] > 2


def test_a_load_process_ends_when_it_is_asked(server: ScriptedServer, tmp_path: Path) -> None:
    marks: list[str] = []
    group = open_loop(commands(tmp_path, "bin", ids=1))

    with LoadProcess(plan(server, tmp_path, "bin", group, seconds=600.0), marks.append) as load:
        load.wait_begun()
        report = load.stop()

    assert isinstance(report, LoadReport)
    assert marks == ["begin", "end"]


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_one_scenario_file_drives_both_generators(server: ScriptedServer, tmp_path: Path, codec: str) -> None:
    asked = LoadScenario(
        robots=2, fps=20.0, seconds=0.5, codec=codec, service="echo", matches=5, seed=3, deadline_s=2.0,
        keep=False, join_every_s=0.05,
    )  # fmt: skip
    scenario = read_scenario(write_scenario(tmp_path / "scenario.json", asked))
    known = [made.echo for made in make_payloads(scenario, SessionSettings())]
    server.echoes = True

    report = run_load(plan_of(scenario, tmp_path, server.port))
    by_c, server.commands = server.commands, []
    result = asyncio.run(drive(scenario, f"ws://127.0.0.1:{server.port}/ws"))

    assert scenario == asked
    assert (report.groups[0].ok, report.groups[0].is_clean) == (20, True)
    assert {command.code for command in result.commands} == {"ok"}
    assert result.wrong_poses == 0
    for sent in (by_c, server.commands):
        assert len(sent) >= 20
        assert {(each.service, each.stream, each.keep) for each in sent} == {("echo", "pose", False)}
        assert all(each.payload["value"] in known for each in sent)
        assert all(0.0 < (each.deadline_ms or 0.0) <= 2000.0 for each in sent)


async def drive(scenario: LoadScenario, url: str) -> SwarmResult:
    """Drive *scenario* by the SDK until as many commands are answered as in its time."""
    swarm = Swarm(scenario, url=url, token_of=lambda robot: robot, session=SessionSettings())
    async with swarm:
        await swarm.start()
        await swarm.wait_joined(READY_S)
        await swarm.wait_answered(int(scenario.robots * scenario.fps * scenario.seconds), READY_S)
        return await swarm.finish(scenario.deadline_s)


def test_robots_join_one_after_another(server: ScriptedServer, tmp_path: Path) -> None:
    scenario = LoadScenario(robots=3, fps=20.0, seconds=0.1, service="echo", join_every_s=0.1)

    assert run_load(plan_of(scenario, tmp_path, server.port)).opening_s >= 0.2


def test_refuses_a_scenario_with_a_link(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="emulates no link"):
        plan_of(LoadScenario(link="paper"), tmp_path, 1)


def test_ends_although_the_server_never_accepts(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=8) as deaf:
        port = deaf.getsockname()[1]
        group = RobotGroup(name="one", robots=1, mode="idle")
        report = run_load(LoadPlan(port=port, groups=(group,), opening_s=0.1, seconds=0.1, drain_s=0.1))

    assert report.timed_out
    assert report.connected == 0


def test_loads_no_other_machine(program: Path) -> None:
    command = [str(program), "--port", "80", "--address", "192.0.2.1", "--group", "a:1:idle:0:-"]

    ended = subprocess.run(command, capture_output=True, text=True, timeout=READY_S, check=False)

    assert ended.returncode == 2
    assert ended.stderr == "load: 192.0.2.1 is not a loopback address; this program loads no other\n"


def test_says_that_a_compiler_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))

    with pytest.raises(ConfigurationError, match="needs a C compiler"):
        compile_generator(tmp_path)
