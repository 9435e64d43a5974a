"""A live map whose server is killed, stopped or drained keeps each keyframe that a robot was told it has."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from server.live_map.test_served import keyframe

from rse_pf.cli.main import main
from rse_pf.local.faults import signal_tree
from rse_pf.local.processes import mark_of
from rse_pf.wire import Command, Result

pytestmark = pytest.mark.system

WAIT_S = 60.0
BEFORE, AFTER = 3, 2
"""Keyframes before and after the fault."""

Fault = Callable[[Any], None]


def kill(server: Any) -> None:
    server.process.kill()


def stop(server: Any) -> None:
    signal_tree(mark_of(server.process.pid), signal.SIGSTOP)


def drain(server: Any) -> None:
    assert server.http("/drain?wait=0", "POST")[0] == 202


@pytest.fixture
def pair(start_server: Any, tmp_path: Path) -> Iterator[tuple[Any, Any]]:
    """Two servers with one store; what was stopped goes on when the test ends."""
    builtin = "from rse_pf.services.builtin import builtin_services as make\n"
    (tmp_path / "served_in_tests.py").write_text(builtin)
    data = {"store": f"dir:{tmp_path / 'store'}"}
    first, second = (start_server(keys=True, data=data) for _ in range(2))
    yield first, second
    if first.process.poll() is None:
        signal_tree(mark_of(first.process.pid), signal.SIGCONT)


async def ask(robot: Any, number: int, service: str, payload: dict[str, Any]) -> Any:
    """Return the reply to one command."""
    await robot.send(
        Command(id=number, service=service, payload=payload, keep=True, deadline_ms=1e3 * WAIT_S)
    )
    answer = await robot.receive(WAIT_S)
    assert isinstance(answer, Result), answer
    return answer.reply


def kept(shown: dict[str, Any]) -> dict[str, int]:
    """Return how many keyframes of each robot the map has."""
    return {each["robot"]: each["keyframes"] for each in shown["robots"]}


@pytest.mark.parametrize("fault", [kill, stop, drain])
def test_a_live_map_goes_on_at_another_server_without_losing_a_keyframe(
    pair: tuple[Any, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: Fault
) -> None:
    first, second = pair

    async def drive() -> tuple[list[int], str, dict[str, Any]]:
        """Return the numbers that the map acknowledged, its first server, and the map at the end."""
        async with second.robot(token=second.token("there")) as there:
            async with first.robot(token=first.token("here")) as here:
                numbers = [
                    (await ask(here, n, "live-keyframe", keyframe(n)))["number"] for n in range(BEFORE)
                ]
            before = await ask(there, 100, "live-show", {"map": "m"})
            await asyncio.to_thread(fault, first)
            for n in range(AFTER):
                numbers.append((await ask(there, n, "live-keyframe", keyframe(n)))["number"])
            return numbers, before["server"], await ask(there, 101, "live-show", {"map": "m"})

    numbers, owner, after = asyncio.run(drive())

    assert numbers == [*range(1, BEFORE + 1), *range(1, AFTER + 1)]
    assert (owner, after["server"]) == ("server-0", "server-1")
    assert kept(after) == {"here": BEFORE, "there": AFTER}
    second.process.kill()
    second.process.wait()
    assert main(["map", "live", "show", "m", "--store", f"dir:{tmp_path / 'store'}", "--json"]) == 0
    replayed = json.loads(capsys.readouterr().out)
    assert (kept(replayed), replayed["keyframes"]) == (kept(after), after["keyframes"])
