"""A burst of handshakes is judged a few at a time, so that robots' frames are served in between."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.websocket import RobotSockets
from tests.kit.worker_parts import WorkerParts, quiet_log

HANDSHAKE_S, ROUND_S = 2e-4, 1e-3
REQUEST = b"GET /nothing HTTP/1.1\r\nHost: a\r\n\r\n"


class Burst:
    """Sockets of strangers before one worker; each refusal takes `HANDSHAKE_S` of the fake clock."""

    def __init__(self, stack: ExitStack, count: int) -> None:
        settings = PlatformSettings.from_dict({"serving": {"trusted_proxies": 1}})
        self.parts = WorkerParts(stack.enter_context(quiet_log()), settings=settings)
        self.ended: list[int] = []
        self.loop = self.parts.loop
        recorder = AuditRecorder(self.parts.clocks, loop=self.loop, send=print, is_on=False)
        self.sockets = RobotSockets(
            self.parts.dispatcher, self.parts.handshake, max_robots=count, workers=1,
            new_name=lambda: "r", recorder=recorder,
        )  # fmt: skip
        pairs = [socket.socketpair() for _ in range(count)]
        self.robots = [stack.enter_context(ours) for ours, _ in pairs]
        self.fds = [theirs.detach() for _, theirs in pairs]

    def take(self) -> None:
        for number, fd in enumerate(self.fds):
            self.sockets.take(fd, lambda number=number: self._end(number), number, "127.0.0.1")

    def _end(self, number: int) -> None:
        self.loop.now += HANDSHAKE_S
        self.ended.append(number)

    def longest_round(self) -> int:
        """Run until nothing happens; return how many sockets ended in one round at most."""
        longest, before = 0, len(self.ended)
        while self.loop.turn():
            longest, before = max(longest, len(self.ended) - before), len(self.ended)
        return longest


@pytest.fixture
def burst() -> Iterator[Burst]:
    with ExitStack() as stack:
        yield Burst(stack, 50)


def test_requests_that_come_with_their_sockets_are_validated_a_few_in_a_round(burst: Burst) -> None:
    for robot in burst.robots:
        robot.sendall(REQUEST)
    burst.take()

    assert burst.ended == []
    assert burst.sockets.is_behind
    assert burst.longest_round() * HANDSHAKE_S <= ROUND_S
    assert burst.ended == list(range(50))
    assert not burst.sockets.is_behind
    assert all(robot.recv(100).startswith(b"HTTP/1.1 404") for robot in burst.robots)


def test_silent_sockets_whose_time_is_over_together_are_ended_a_few_in_a_round(burst: Burst) -> None:
    burst.take()
    burst.longest_round()
    burst.loop.now += burst.parts.settings.session.hello_timeout_s

    assert burst.longest_round() * HANDSHAKE_S <= ROUND_S
    assert sorted(burst.ended) == list(range(50))
