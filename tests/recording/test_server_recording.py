"""Real servers, real recordings: what is in them, what is not, and what a kill -9 leaves of them."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import random
import signal
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from client_sdk import connect
from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.reader import open_recording
from rse_pf.pnp.problems import make_problem
from rse_pf.wire import CODECS
from tests.kit.guarded_server import KEY, GuardedServer

pytestmark = [pytest.mark.slow, pytest.mark.system]

PROBLEM = make_problem(seed=3, outlier_ratio=0.2)
NAMES = ("käthe-the-robot", "r2d2-of-warehouse", "seventh")
TENANTS = ("warehouse-south", "default", "acme")
_DEADLINE_S = 30.0


def families(pid: int) -> Iterator[int]:
    """Yield *pid* and its descendants."""
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from families(int(child))


def recorder_of(folder: Path) -> int:
    """Return the process of the recorder."""
    pid = json.loads((folder / "announce.json").read_text())["pid"]
    until = time.monotonic() + _DEADLINE_S
    while time.monotonic() < until:
        for each in families(pid):
            with suppress(OSError):
                if Path(f"/proc/{each}/comm").read_text().strip() == "rse-pf recorder":
                    return each
        os.sched_yield()
    raise AssertionError("there is no recorder")


def wait_written(folder: Path) -> None:
    """Wait until no process writes to *folder* any more."""
    until = time.monotonic() + _DEADLINE_S
    for file in folder.iterdir():
        with file.open("rb") as opened:
            while time.monotonic() < until:
                try:
                    fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    os.sched_yield()


def texts(file: Path) -> Iterator[bytes]:
    """Yield all of a file, and every message of it inflated."""
    yield file.read_bytes()
    channels: dict[int, Channel] = {}
    with file.open("rb") as stream, suppress(McapError):
        for record in StreamReader(stream).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                is_zlib = channels[record.channel_id].metadata.get("codec") == "zlib"
                yield zlib.decompress(record.data) if is_zlib else record.data


def test_no_token_key_or_name_is_in_a_recording(tmp_path: Path):
    recordings = tmp_path / "recordings"
    tokens: list[str] = []

    async def drive(server: GuardedServer, name: str, tenant: str, codec: str) -> None:
        async def token() -> str:
            tokens.append(server.token(name, tenant=tenant, ttl_s=10))
            return tokens[-1]

        async with connect(server.url, token=token, codec=codec) as robot:
            for number in range(30):
                await robot.solve_pnp(
                    PROBLEM.points_world,
                    PROBLEM.pixels,
                    PROBLEM.camera,
                    stream=name if number % 3 else "pose",
                )
                for service, request in (("echo", {"value": name}), (name, {"who": tokens[-1]})):
                    with suppress(RsePfError):
                        await robot.call(service, request)
            with suppress(RsePfError):
                await robot.call("pnp", {"camera": name, "points_world": [], "pixels": tokens[-1]})
            until = time.monotonic() + _DEADLINE_S
            while len(tokens) < 2 * len(NAMES) and time.monotonic() < until:
                await asyncio.sleep(0.2)
                await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera)

    async def all_robots(server: GuardedServer) -> None:
        kinds = zip(NAMES, TENANTS, CODECS, strict=True)
        await asyncio.gather(*(drive(server, *each) for each in kinds))

    with GuardedServer(tmp_path, recording={"folder": str(recordings)}, auth={"leeway_s": 0}) as server:
        asyncio.run(all_robots(server))
    wait_written(recordings)

    (file,) = recordings.iterdir()
    parts = [part for token in tokens for part in (token, *token.split(".")[1:])]
    names = [each for each in (*NAMES, *TENANTS) if each != "default"]
    forbidden = {*parts, *names, *(json.dumps(each)[1:-1] for each in names), (b"g" * 32).hex(), KEY.key_id}
    found = [(each, text[:80]) for text in texts(file) for each in forbidden if each.encode() in text]
    assert found == []
    assert len(tokens) > len(NAMES), "no token was renewed"
    commands = list(open_recording(file).commands())
    assert sum(each.reply is not None for each in commands) >= 3 * 30
    assert len({each.robot for each in commands}) == 3


@pytest.mark.timeout(400)
@pytest.mark.parametrize("victim", ["recorder", "server"])
def test_a_recording_that_was_killed_opens_and_lacks_at_most_the_last_second(tmp_path: Path, victim: str):
    chance = random.Random(victim)
    recordings = tmp_path / "recordings"

    async def drive(server: GuardedServer, kill_after_s: float) -> tuple[list[float], float]:
        """Ask until the kill; return when answers came (Unix), and when the kill was."""
        answered: list[float] = []
        killed_s = 0.0
        async with connect(server.url, token=server.token("robot-1"), codec="bin") as robot:
            recorder, began = recorder_of(tmp_path), time.monotonic()
            while time.monotonic() - began < kill_after_s:
                await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera)
                answered.append(time.time())
                await asyncio.sleep(0.02)
            killed_s = time.time()
            if victim == "recorder":
                os.kill(recorder, signal.SIGKILL)
                for _ in range(5):  # robots continue
                    await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera)
            else:
                server.stop()
        return answered, killed_s

    for _ in range(5):
        for file in recordings.glob("*"):
            file.unlink()
        with GuardedServer(tmp_path, recording={"folder": str(recordings)}) as server:
            answered, killed_s = asyncio.run(drive(server, chance.uniform(1.5, 2.5)))
        wait_written(recordings)

        commands = [each for each in open_recording(recordings).commands() if each.reply is not None]
        due = [each for each in answered if each < killed_s - 1.0]
        assert len(commands) >= len(due) > 10, (len(commands), len(due), len(answered))
