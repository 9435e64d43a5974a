"""A robot of the demo that cannot write its files reports one line to its parent."""

from __future__ import annotations

import errno
from typing import Any

import pytest

from rse_pf.extensions.experiments.child_process import ChildFailed
from rse_pf.extensions.experiments.demo import robot


class Pipe:
    """Keeps what the robot sends."""

    def __init__(self, *_: object) -> None:
        sent.append(self)
        self.messages: list[Any] = []

    def listen(self) -> None: ...

    def send(self, message: Any) -> None:
        self.messages.append(message)


sent: list[Pipe] = []


def test_a_full_disk_is_reported_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    async def fill(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "out/robot-1/map.ply")

    sent.clear()
    monkeypatch.setattr(robot, "_run", fill)
    monkeypatch.setattr(robot, "ParentPipe", Pipe)
    spec: Any = type("Spec", (), {"name": "robot-1"})()

    robot.run_robot(spec, None)  # type: ignore[arg-type]

    (failed,) = sent[0].messages
    assert isinstance(failed, ChildFailed)
    error = failed.error("robot-1")
    assert error.message == "robot-1: StoreFull: No space left on device: 'out/robot-1/map.ply'"
    assert "free some space" in error.hint
