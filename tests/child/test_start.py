"""How a child process starts, what it may use, and how it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rse_pf.child.start import Child, ChildPlan, how_ended, start_child
from rse_pf.ipc import receive

pytestmark = pytest.mark.system
WITHIN_S = 20.0


@contextmanager
def child(target: str = "tell", environment: dict[str, str] | None = None, **plan: Any) -> Iterator[Child]:
    started = start_child(
        ChildPlan(target=f"tests.child.told_children:{target}", name="a child", **plan),
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
        "oom": "1000", "sockets": 1, "secret": "",
    }  # fmt: skip


def test_an_import_at_a_lower_priority_leaves_the_child_at_that_of_its_parent() -> None:
    with child(import_nice=5) as started:
        assert told(started)["nice"] == os.nice(0)


def test_a_child_with_an_environment_of_its_own_has_nothing_of_its_parents(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SECRET", "key")
    with child() as started, child(environment={"PYTHONPATH": os.getcwd()}) as alone:
        assert told(started)["secret"] == "key"
        assert told(alone)["secret"] == ""


def test_the_signals_of_a_terminal_are_ignored_and_the_end_of_the_socket_ends_a_child() -> None:
    with child() as started:
        told(started)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(started.pid, number)
        told(started)
        assert started.exit_code() is None

        assert started.end(WITHIN_S) == 0


def test_a_child_that_does_not_end_is_killed_and_reaped() -> None:
    with child("stay") as started:
        receive(started.connection)
        code = started.end(0.01)

        assert how_ended(code) == "signal SIGKILL"
        assert not Path(f"/proc/{started.pid}").exists()


def test_a_message_to_a_child_that_has_ended_is_lost() -> None:
    with child("stay") as started:
        receive(started.connection)
        os.kill(started.pid, signal.SIGKILL)
        assert started.wait() == -signal.SIGKILL

        started.say("tell")
        assert receive(started.connection) is None


@pytest.mark.parametrize(
    ("code", "how"), [(0, "exit code 0"), (3, "exit code 3"), (-9, "signal SIGKILL"), (-40, "signal 40")]
)
def test_an_exit_code_is_told_in_words(code: int, how: str) -> None:
    assert how_ended(code) == how
