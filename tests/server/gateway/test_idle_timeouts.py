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
        self.opened_s = self.last_heard_s = 0.0

    @property
    def is_closing(self) -> bool:
        return bool(self.closed)

    def close(self, code: int, reason: str) -> None:
        assert not self.closed, "closed twice"
        self.closed = (code, reason)


class Worker:
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
            socket.last_heard_s, socket.is_opening = self.now, False
        self.unread.clear()


def closed_at(worker: Worker, socket: Connection, *, late_s: float = 0.0) -> float:
    while not socket.closed and worker.now < 60.0:
        worker.run(worker.now + 0.01, late_s=late_s)
    return worker.now


@pytest.mark.parametrize("heard_s", [0.0, 0.01, 0.1, 0.2, 0.24, 0.9])
def test_a_silent_robot_is_noticed_within_the_limit_whenever_it_fell_silent(heard_s):
    robot = Connection()
    worker = Worker(robot)
    worker.run(heard_s)
    robot.last_heard_s = heard_s

    noticed_s = closed_at(worker, robot) - heard_s

    assert LIMIT_S <= noticed_s <= BAR_S
    assert noticed_s <= LIMIT_S + 0.3
    assert robot.closed == (1001, "silent")


def test_a_busy_loop_notices_a_silent_robot_within_the_limit():
    robot = Connection()
    worker = Worker(robot)

    while not robot.closed:
        worker.now += max(0.0, worker.timeouts.until_tick_s(worker.now)) + 0.15
        worker.timeouts.close_idle(worker.sockets, worker.now)

    assert worker.now <= BAR_S


def test_messages_that_arrived_while_the_worker_was_stopped_are_read_before_it_closes():
    robot, mute = Connection(), Connection()
    worker = Worker(robot, mute)
    worker.run(LIMIT_S - 0.3)
    worker.unread[robot] = worker.now

    worker.sleep(0.9)
    worker.run(worker.now + 0.3)

    assert not robot.closed
    assert mute.closed


def test_time_in_which_the_worker_was_stopped_does_not_count_as_silence():
    robot = Connection()
    worker = Worker(robot)
    worker.run(3.0)

    worker.sleep(20.0)
    worker.run(worker.now + 1.5)
    assert not robot.closed

    assert closed_at(worker, robot) - 20.0 <= BAR_S


def test_a_hello_that_arrived_while_the_worker_was_stopped_is_in_time():
    said, mute = Connection(is_opening=True), Connection(is_opening=True)
    worker = Worker(said, mute)
    worker.run(SETTINGS.hello_timeout_s - 0.3)
    worker.unread[said] = worker.now

    worker.sleep(0.9)
    worker.run(worker.now + 0.3)

    assert not said.closed
    assert mute.closed == (4400, "no-hello")


def test_connections_are_looked_at_about_four_times_a_second():
    robots = [Connection() for _ in range(3)]
    worker = Worker(*robots)
    for second in range(1, 11):
        worker.run(float(second))
        for robot in robots:
            robot.last_heard_s = worker.now

    assert worker.looks <= 41


@pytest.mark.parametrize("interval_s", [0.05, 0.5, 2.0])
@pytest.mark.parametrize("hello_s", [0.2, 5.0])
def test_the_limit_follows_the_settings(interval_s, hello_s):
    settings = SessionSettings(ping_interval_s=interval_s, ping_timeout_s=1.0, hello_timeout_s=hello_s)
    robot = Connection()

    noticed_s = closed_at(Worker(robot, settings=settings), robot)

    assert interval_s + 1.0 <= noticed_s <= interval_s + 1.3
