"""The connection of a silent robot is closed in time, and none for what its worker did not read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rse_pf.config import SessionSettings
from rse_pf.server.gateway.idle_timeouts import IdleTimeouts, max_silence_s

SETTINGS = SessionSettings()
LIMIT_S = max_silence_s(SETTINGS)
BAR_S = 5.8
"""A silent link must be noticed within 6 s; the difference is for the observer of the server."""


class Connection:
    """As much of a connection as the idle timeouts look at."""

    def __init__(self, *, is_opening: bool = False) -> None:
        self.session = SimpleNamespace()
        self.is_opening = is_opening
        self.closed: Any = False
        self.opened_s = self.last_message_s = 0.0

    @property
    def is_closing(self) -> bool:
        return bool(self.closed)

    def close(self, code: int, reason: str) -> None:
        assert not self.closed, "closed twice"
        self.closed = (code, reason)


class PollingLoop:
    """A loop: looks when it is time, and reads in between unless it sleeps."""

    def __init__(self, *sockets: Any, settings: SessionSettings = SETTINGS) -> None:
        self.now = 0.0
        self.sockets = sockets
        self.unread: dict[Any, float] = {}
        self.timeouts = IdleTimeouts(settings, 0.0)
        self.looks = 0

    def run(self, until_s: float, *, late_s: float = 0.0) -> None:
        """Look as often as is due, each time *late_s* late."""
        while self.now + max(0.0, self.timeouts.until_tick_s(self.now)) + late_s <= until_s:
            self.now += max(0.0, self.timeouts.until_tick_s(self.now)) + late_s
            self.timeouts.close_idle(self.sockets, self.now)
            self.looks += 1
            self.read()
        self.now = until_s

    def sleep(self, seconds: float) -> None:
        """Do nothing for so long; then the timers come first, as in libuv, and the sockets after them."""
        self.now += seconds
        self.timeouts.close_idle(self.sockets, self.now)
        self.read()

    def read(self) -> None:
        for socket in [each for each in self.unread if not each.closed]:
            socket.last_message_s, socket.is_opening = self.now, False
        self.unread.clear()


def closed_at(worker: PollingLoop, socket: Connection, *, late_s: float = 0.0) -> float:
    while not socket.closed and worker.now < 60.0:
        worker.run(worker.now + 0.01, late_s=late_s)
    return worker.now


@pytest.mark.parametrize("message_s", [0.0, 0.01, 0.1, 0.2, 0.24, 0.9])
def test_a_silent_robot_is_noticed_within_the_limit_whenever_it_fell_silent(message_s):
    robot = Connection()
    worker = PollingLoop(robot)
    worker.run(message_s)
    robot.last_message_s = message_s

    noticed_s = closed_at(worker, robot) - message_s

    assert LIMIT_S <= noticed_s <= BAR_S
    assert noticed_s <= LIMIT_S + 0.3
    assert robot.closed == (1001, "silent")


def test_messages_that_arrived_while_the_worker_was_stopped_are_read_before_it_closes():
    robot, mute = Connection(), Connection()
    worker = PollingLoop(robot, mute)
    worker.run(LIMIT_S - 0.3)
    worker.unread[robot] = worker.now

    worker.sleep(0.9)
    worker.run(worker.now + 0.3)

    assert not robot.closed
    assert mute.closed


def test_time_in_which_the_worker_was_stopped_does_not_count_as_silence():
    robot = Connection()
    worker = PollingLoop(robot)
    worker.run(3.0)

    worker.sleep(20.0)
    worker.run(worker.now + 1.5)
    assert not robot.closed

    assert closed_at(worker, robot) - 20.0 <= BAR_S
