"""How a child process starts, what it may use, and how it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from rse_pf.processes.fork_server import read_packet, send_order, start_fork_server
from rse_pf.processes.ipc import receive
from rse_pf.processes.start import Child, ChildPlan, how_ended, start_child

pytestmark = pytest.mark.system
WITHIN_S = 20.0


@contextmanager
def child(target: str = "tell", environment: dict[str, str] | None = None, **plan: Any) -> Iterator[Child]:
    started = start_child(
        ChildPlan(target=f"tests.kit.child_processes:{target}", name="a child", **plan),
        environment=environment,
    )
    try:
        yield started
    finally:
        started.kill()


def told(started: Child) -> dict[str, Any]:
    started.say("tell")
    answer: dict[str, Any] = receive(started.connection, time.monotonic() + WITHIN_S)
    return answer


def test_a_child_has_its_name_its_limits_and_one_socket() -> None:
    nice = os.nice(0)
    with child(memory_bytes=1 << 30, is_killed_first=True, policy="batch", nice=3) as started:
        answer = told(started)

    assert answer == {
        "name": "a child", "policy": os.SCHED_BATCH, "nice": min(19, nice + 3), "memory": 1 << 30, "core": 0,
        "oom": "1000", "sockets": 1, "word": "",
    }  # fmt: skip


def test_a_child_with_an_environment_of_its_own_has_nothing_of_its_parents(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("A_WORD", "kept")
    with child() as started, child(environment={"PYTHONPATH": os.getcwd()}) as alone:
        assert told(started)["word"] == "kept"
        assert told(alone)["word"] == ""


def test_the_signals_of_a_terminal_are_ignored_and_the_end_of_the_socket_ends_a_child() -> None:
    with child() as started:
        told(started)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(started.pid, number)
        told(started)
        assert started.exit_code() is None

        assert started.end(WITHIN_S) == 0


def test_a_fork_that_must_not_begin_is_killed_with_the_reason_and_others_on_order() -> None:
    server = start_fork_server(ChildPlan(target="tests.kit.child_processes:fork", name="forks"), None)
    server.connection.settimeout(WITHIN_S)

    def report() -> dict[str, Any]:
        told, handles = read_packet(server.connection)
        for handle in handles:
            os.close(handle)
        return {"event": told["event"], "id": told.get("id"), "how": told.get("how")}

    try:
        assert report()["event"] == "ready"
        send_order(server, "create", 2)
        assert [report(), report()] == [
            {"event": "created", "id": 2, "how": None}, {"event": "gone", "id": 2, "how": "not today"}
        ]  # fmt: skip
        send_order(server, "create", 1)
        assert report()["event"] == "created"
        send_order(server, "end", 1)
        assert report() == {"event": "gone", "id": 1, "how": "signal SIGKILL"}
    finally:
        assert server.end(WITHIN_S) == 0


@pytest.mark.parametrize(
    ("code", "how"), [(0, "exit code 0"), (3, "exit code 3"), (-9, "signal SIGKILL"), (-40, "signal 40")]
)
def test_an_exit_code_is_reported_in_words(code: int, how: str) -> None:
    assert how_ended(code) == how
