"""What a worker says reaches the recorder in order, and a recorder that does not read holds nobody up."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator

import pytest

from rse_pf.extensions.recording.tap import (
    LOST,
    UP,
    PipeEntry,
    PipeReader,
    RecordingTap,
    recording_pipe,
)
from rse_pf.identity import RobotId

ROBOT = RobotId("default", "robot-1")


class Loop:
    """Calls what is due when it is reported to."""

    def __init__(self) -> None:
        self.due: list[Callable[[], None]] = []

    def call_later(self, seconds: float, call: Callable[[], None]) -> None:
        self.due.append(call)

    def turn(self) -> None:
        due, self.due = self.due, []
        for call in due:
            call()


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = recording_pipe()
    os.set_blocking(ends[0], False)
    yield ends
    for end in ends:
        try:
            os.close(end)
        except OSError:
            continue


def read(fd: int, reader: PipeReader) -> list[PipeEntry]:
    found: list[PipeEntry] = []
    try:
        while data := os.read(fd, 10_007):
            found += reader.entries(data)
    except BlockingIOError:
        pass
    return found


def test_a_recorder_that_does_not_read_costs_messages_and_no_time(pipe: tuple[int, int]):
    loop = Loop()
    tap = RecordingTap(pipe[1], call_later=loop.call_later)
    number = tap.open_connection("bin", ROBOT)

    for _ in range(150):
        tap.observe_received(number, bytes(100_000))
        loop.turn()
    assert 0 < tap.dropped < 150
    reader, found = PipeReader(), list[PipeEntry]()
    for _ in range(400):
        found += read(pipe[0], reader)
        loop.turn()

    assert sum(each.kind == UP for each in found) == 150 - tap.dropped
    (lost,) = [each for each in found if each.kind == LOST]
    assert struct.unpack("<Q", lost.data) == (tap.dropped,)


def test_a_recorder_that_died_is_reported_once_and_everything_goes_on(pipe: tuple[int, int]):
    loop, reported = Loop(), list[str]()
    tap = RecordingTap(pipe[1], call_later=loop.call_later, on_dead=lambda: reported.append("dead"))
    number = tap.open_connection("bin", ROBOT)
    tap.observe_received(number, b"x")
    os.close(pipe[0])

    loop.turn()
    for _ in range(3):
        tap.observe_sent(number, b"x")
        loop.turn()

    assert reported == ["dead"]
    assert (tap.is_dead, tap.dropped, loop.due) == (True, 4, [])
