"""The pipe of a demo robot: tokens and start time on any thread, and the end of the parent."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection

import pytest

from rse_pf.errors import Disconnected
from rse_pf.extensions.experiments.child_process import IssuedToken, ParentPipe, TokenRequest


def pair(clock: list[float]) -> tuple[ParentPipe, Connection]:
    mine, theirs = multiprocessing.Pipe()
    robot = ParentPipe(mine, "robot-1", clock=lambda: clock[0])
    robot.listen()
    return robot, theirs


@contextlib.contextmanager
def workers(parent: Connection) -> Iterator[ThreadPoolExecutor]:
    """Give threads, and close the pipe at the end so that none waits for ever."""
    with ThreadPoolExecutor() as pool:
        try:
            yield pool
        finally:
            parent.close()


def answer(parent: Connection, count: int) -> None:
    """Answer *count* questions with token-1, token-2, ..."""
    for number in range(1, count + 1):
        assert parent.recv() == TokenRequest("robot-1")
        parent.send(IssuedToken("robot-1", f"token-{number}"))


def test_a_token_before_the_start_is_not_taken_for_the_start() -> None:
    robot, parent = pair([0.0])
    with workers(parent) as pool:
        start = pool.submit(robot.wait_start)
        token = pool.submit(robot.fresh_token)
        answer(parent, 1)
        assert token.result(10) == "token-1"
        parent.send(7.5)
        assert start.result(10) == 7.5


def test_the_end_of_the_parent_ends_every_wait() -> None:
    robot, parent = pair([0.0])
    with workers(parent) as pool:
        waiting = [pool.submit(robot.wait_start) for _ in range(2)]
        parent.close()
        for each in waiting:
            with pytest.raises(Disconnected):
                each.result(10)
