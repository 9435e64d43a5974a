"""What a hostile service may use of a server: processor time after its answer, memory, threads."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import pytest

from rse_pf.processes.linux import cpu_seconds
from rse_pf.services.custom.installed import install
from rse_pf.wire import Failure, Result

pytestmark = pytest.mark.system

HOSTILE = """
from __future__ import annotations
import mmap, threading, time, msgspec

class Request(msgspec.Struct):
    do: str = "look"

class Reply(msgspec.Struct):
    got: float = 0.0

HELD = []

def work():
    while True: pass

def hold():
    block = mmap.mmap(-1, 8 << 20)
    for at in range(0, len(block), 4096):
        block[at] = 1
    HELD.append(block)

def serve(request: Request) -> Reply:
    if request.do == "work_on":
        for _ in range(3): threading.Thread(target=work, daemon=True).start()
    if request.do == "threads":
        while True: threading.Thread(target=time.sleep, args=(99,), daemon=True).start()
    if request.do == "hold":
        while True: hold()
    return Reply(got=time.process_time())
"""


@pytest.fixture
def hostile_server(start_server, tmp_path):
    """A server with a hostile service."""
    folder = tmp_path / "hostile"
    folder.mkdir()
    (folder / "service.py").write_text(HOSTILE)
    manifest = {"name": "hostile", "language": "python", "entry": "service.py", "kind": "stateless"}
    (folder / "service.json").write_text(json.dumps(manifest))
    install(folder, tmp_path / "s")
    limits = {"folder": str(tmp_path / "s"), "memory_bytes": 300_000_000, "breaker_crashes": 1000}
    return start_server(keys=True, services=limits, session={"max_commands_per_s": 0.0})


def below(pid: int) -> list[int]:
    """Return the pids whose parent is *pid*."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == pid:
            found.append(int(stat.parent.name))
    return found


async def test_threads_that_work_after_the_answer_get_no_processor_time(hostile_server):
    async with (
        hostile_server.robot(token=hostile_server.token("hostile")) as robot,
        hostile_server.robot(token=hostile_server.token("other")) as other,
    ):
        first = await robot.ask(1, "hostile", {"do": "work_on"})
        ((sandbox,),) = [below(zygote) for zygote in below(hostile_server.workers[0])]
        before, end = cpu_seconds(sandbox), time.monotonic() + 0.5
        number = 0
        while time.monotonic() < end:
            number += 1
            assert isinstance(await other.ask(number, "echo", {}), Result)
        used = cpu_seconds(sandbox) - before
        second = await robot.ask(2, "hostile", {})

    assert isinstance(first, Result)
    assert round(used, 6) <= 0.02, "at most one tick of the clock and the time of its own answer"
    assert isinstance(second, Result), "it runs again when it is asked"


def test_memory_and_threads_end_at_their_limits_with_a_typed_failure(hostile_server):
    async def run(harm):
        async with hostile_server.robot(token=hostile_server.token(harm)) as robot:
            harmed = await robot.ask(1, "hostile", {"do": harm}, deadline_ms=5000.0, keep=True)
            return harmed, await robot.ask(2, "hostile", {}, deadline_ms=5000.0, keep=True)

    for harm in ("hold", "threads"):
        harmed, after = asyncio.run(run(harm))
        assert isinstance(harmed, Failure), harm
        assert harmed.code in ("internal", "worker-lost", "poison"), harm
        assert isinstance(after, Result), harm
