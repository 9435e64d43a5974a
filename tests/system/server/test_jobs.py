"""Long services as jobs, in real servers and processes: they outlive their server, and each is answered."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from typing import Any

import pytest

import client_sdk
from rse_pf.errors import Cancelled, Crashed, Expired
from rse_pf.storage.object_store import DirectoryStore, digest_of
from rse_pf.wire import Command

pytestmark = pytest.mark.system

_SERVICES = '''
import ctypes, os, signal, time
from pathlib import Path
from typing import Any
import msgspec
from rse_pf.service import Registry, Report
from rse_pf.services import echo

FOLDER = Path(__file__).parent

class Work(msgspec.Struct, frozen=True, kw_only=True):
    name: str = "job"
    deaf: bool = False
    fate: str = ""
    fill: int = 0

class Done(msgspec.Struct, frozen=True, kw_only=True):
    filling: str = ""

def make(settings):
    registry = Registry()
    echo.register(registry)

    @registry.service("crash")
    def crash(request: Work) -> Done:
        ctypes.string_at(0)
        return Done()

    @registry.service("long", kind="long")
    def long(request: Work, *, report: Report) -> Done:
        """Report until a file appears."""
        with (FOLDER / "runs").open("a") as runs:
            runs.write(f"{os.getpid()}\\n")
        if request.fate == "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        if request.fate == "memory":
            return Done(filling="x" * (1 << 40))
        report(0.5, "half")
        while not (FOLDER / request.name).exists():
            if not request.deaf:
                report(0.5, "half")
            time.sleep(0.01)
        return Done(filling="x" * request.fill)

    return registry
'''


class Relay:
    """A load balancer that forwards to one server at a time."""

    def __init__(self) -> None:
        self.target = 0
        self._cutters: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> Relay:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.url = f"ws://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/ws"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.cut()

    def cut(self) -> None:
        """End every connection."""
        for writer in list(self._cutters):
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.transport.abort()
            return
        self._cutters |= {writer, back}
        await asyncio.gather(self._pump(reader, back), self._pump(there, writer))
        self._cutters -= {writer, back}

    @staticmethod
    async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(65536):
                writer.write(data)
        writer.transport.abort()


class Heard:
    """Progress that a robot was sent, and a way to wait for it."""

    def __init__(self) -> None:
        self.told: list[tuple[float, str]] = []
        self.at: list[float] = []
        self._more = asyncio.Event()

    def __call__(self, done: float, what: str) -> None:
        self.told.append((done, what))
        self.at.append(time.monotonic())
        self._more.set()

    async def until(self, what: str, within_s: float = 50.0) -> None:
        """Return when *what* is sent from now on: jobs have what other processes leave of the machine."""
        self._more.clear()
        seen = len(self.told)
        until = time.monotonic() + within_s
        while not any(said == what for _, said in self.told[seen:]):
            await asyncio.wait_for(self._more.wait(), until - time.monotonic())
            self._more.clear()


@pytest.fixture
def platform(start_server, tmp_path):
    """Return a function that starts a server with jobs on the store that all of them share."""
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)

    def start(**serving: Any):
        chosen = {"job_lease_s": 1.0, "drain_wait_s": 0.0, **serving}
        return start_server(keys=True, serving=chosen, data={"store": f"dir:{tmp_path / 'store'}"})

    return start


@pytest.fixture
def runs(tmp_path):
    """Return the function that gives the processes which worked, in order."""

    def read() -> list[int]:
        path = tmp_path / "runs"
        return [int(line) for line in path.read_text().split()] if path.exists() else []

    return read


def asked(robot: client_sdk.Robot, heard: Heard | None = None, **request: Any) -> asyncio.Task[Any]:
    return asyncio.create_task(robot.call("long", request, on_progress=heard or Heard()))


async def test_a_job_gives_way_to_robots_and_its_result_is_stored(platform, runs, tmp_path):
    server, heard = platform(), Heard()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        task = asked(robot, heard, fill=3)
        await heard.until("half")
        (process,) = runs()
        assert os.getpriority(os.PRIO_PROCESS, process) == min(19, os.nice(0) + 10)
        assert os.sched_getscheduler(process) == os.SCHED_BATCH
        assert process not in (server.process.pid, *server.workers)
        (tmp_path / "job").touch()
        first = await task
        again = await robot.call("long", {"fill": 3})

    assert first.reply == again.reply == {"filling": "xxx"}
    assert first.object == again.object
    assert runs() == [process]
    kept = DirectoryStore(tmp_path / "store").get(f"objects/default/robot-1/{first.object}")
    assert digest_of(kept) == first.object
    assert client_sdk.decode_reply(kept, dict) == first.reply


@pytest.mark.slow
async def test_a_reply_too_large_for_a_message_is_answered_with_its_object_name(platform, tmp_path):
    server = platform()
    (tmp_path / "job").touch()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        answer = await robot.call("long", {"fill": 300_000}, on_progress=Heard())

    assert answer.reply is None
    kept = DirectoryStore(tmp_path / "store").get(f"objects/default/robot-1/{answer.object}")
    assert client_sdk.decode_reply(kept, dict) == {"filling": "x" * 300_000}


async def test_a_job_ends_on_the_other_server_when_its_own_is_killed(platform, runs, gone, tmp_path):
    first, second, heard = platform(), platform(), Heard()
    async with Relay() as relay:
        relay.target = first.port
        async with client_sdk.connect(relay.url, token=first.token()) as robot:
            task = asked(robot, heard)
            await heard.until("half")
            relay.target = second.port
            first.process.send_signal(signal.SIGKILL)
            await asyncio.to_thread(gone, runs()[0])
            while len(runs()) < 2:
                await heard.until("half")
            (tmp_path / "job").touch()
            answer = await task

    assert answer.server == "server-1"
    assert len(runs()) == 2


@pytest.mark.slow
async def test_after_a_reconnect_the_robot_waits_for_the_same_run(platform, runs, tmp_path):
    server, heard = platform(), Heard()
    async with Relay() as relay:
        relay.target = server.port
        async with client_sdk.connect(relay.url, token=server.token()) as robot:
            task = asked(robot, heard)
            await heard.until("half")
            relay.cut()
            await heard.until("half")
            (tmp_path / "job").touch()
            answer = await task

    assert answer.reply == {"filling": ""}
    assert len(runs()) == 1


@pytest.mark.slow
async def test_a_draining_server_gives_up_its_jobs_at_once(platform, runs, tmp_path):
    first, second, heard = platform(job_lease_s=600.0), platform(job_lease_s=600.0), Heard()
    async with Relay() as relay:
        relay.target = first.port
        async with client_sdk.connect(relay.url, token=first.token()) as robot:
            task = asked(robot, heard)
            await heard.until("half")
            relay.target = second.port
            first.http("/drain", "POST")
            while len(runs()) < 2:
                await heard.until("half")
            (tmp_path / "job").touch()
            answer = await task

    assert answer.server == "server-1"
    assert len(runs()) == 2


@pytest.mark.parametrize(
    "deaf", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["listens", "is deaf"]
)
async def test_a_cancelled_job_ends(platform, runs, gone, deaf):
    server, heard = platform(), Heard()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        task = asked(robot, heard, deaf=deaf)
        await heard.until("half")
        task.cancel()
        await asyncio.to_thread(gone, runs()[0])

        with pytest.raises(Expired):
            await robot.call("long", {"deaf": deaf}, deadline_s=0.2)


@pytest.mark.slow
async def test_a_cancel_on_another_server_ends_the_job_where_it_runs(platform, runs, gone):
    first, second, heard = platform(), platform(), Heard()
    async with (
        client_sdk.connect(first.url, token=first.token()) as one,
        client_sdk.connect(second.url, token=second.token()) as other,
    ):
        running = asked(one, heard)
        await heard.until("half")
        follower = Heard()
        following = asked(other, follower)
        await follower.until("half")
        following.cancel()
        await asyncio.to_thread(gone, runs()[0])
        with pytest.raises(Cancelled):
            await running

    assert len(runs()) == 1


@pytest.mark.parametrize("fate", ["crash", pytest.param("memory", marks=pytest.mark.slow)])
async def test_a_job_that_crashes_is_a_typed_failure_and_the_server_keeps_running(platform, fate):
    server = platform()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        with pytest.raises(Crashed, match="SIGSEGV" if fate == "crash" else "memory"):
            await robot.call("long", {"fate": fate}, on_progress=Heard())
        assert (await robot.call("echo", {"value": 1})).reply == {"value": 1}


async def test_a_job_whose_worker_another_robot_crashed_runs_again_on_that_server(platform, runs, tmp_path):
    server, heard = platform(), Heard()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        task = asked(robot, heard)
        await heard.until("half")
        async with server.robot(token=server.token("culprit")) as culprit:
            await culprit.send(Command(id=1, service="crash"))
            await asyncio.wait_for(culprit.socket.wait_closed(), 5.0)
        while len(runs()) < 2:
            await heard.until("half")
        (tmp_path / "job").touch()
        answer = await task

    assert answer.reply == {"filling": ""}
    assert server.process.poll() is None


@pytest.mark.slow
async def test_one_job_runs_at_a_time_and_others_wait(platform, runs, tmp_path):
    server, heard = platform(), Heard()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        first = asked(robot, heard, name="a")
        await heard.until("half")
        waiting = Heard()
        second = asked(robot, waiting, name="b")
        await waiting.until("waits for its turn")
        assert len(runs()) == 1
        (tmp_path / "b").touch()
        (tmp_path / "a").touch()
        await asyncio.gather(first, second)

    assert len(runs()) == 2


@pytest.mark.slow
async def test_progress_is_sent_at_most_twice_a_second(platform, tmp_path):
    server, heard = platform(), Heard()
    async with client_sdk.connect(server.url, token=server.token()) as robot:
        task = asked(robot, heard)
        for _ in range(3):
            await heard.until("half")
        (tmp_path / "job").touch()
        await task

    pauses = [after - before for before, after in zip(heard.at, heard.at[1:], strict=False)]
    assert sum(pauses) / len(pauses) > 0.45
