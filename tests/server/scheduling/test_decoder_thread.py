"""The decoder thread takes the messages of robots that sent undecodable ones last."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.errors import LimitExceeded
from rse_pf.server.scheduling.decoder_thread import DecoderThread
from rse_pf.server.worker_context import NoCrashMarks
from tests.kit.fakes import FakeLoop

DEADLINE_S = 10.0


@pytest.fixture
def loop() -> FakeLoop:
    return FakeLoop()


@pytest.fixture
def defects() -> list[Exception]:
    return []


@pytest.fixture
def decoder(loop: FakeLoop, defects: list[Exception]) -> Iterator[DecoderThread]:
    made = DecoderThread(loop.call_soon_threadsafe, NoCrashMarks(), defects.append)
    yield made
    made.close()


class HeldCodec:
    """A codec that decodes when it may, and notes what it decoded."""

    name, is_text = "zlib", False

    def __init__(self) -> None:
        self.may_decode = threading.Event()
        self.has_begun = threading.Event()
        self.decoded: list[bytes] = []

    def decode_from_robot(self, data: bytes) -> Any:
        self.has_begun.set()
        assert self.may_decode.wait(DEADLINE_S)
        self.decoded.append(data)
        raise LimitExceeded("too large")


def test_a_robot_that_sent_undecodable_messages_comes_last_whatever_came_first(
    loop: FakeLoop, decoder: DecoderThread
):
    codec: Any = HeldCodec()
    heard: list[Any] = []

    decoder.begin(codec, b"first", number=1, suspicion=0, done=heard.append)
    assert codec.has_begun.wait(DEADLINE_S)
    for data, suspicion in ((b"worst", 2), (b"suspect", 1), (b"honest", 0), (b"honest too", 0)):
        decoder.begin(codec, data, number=1, suspicion=suspicion, done=heard.append)
    assert decoder.unread_bytes == len(b"firstworstsuspecthonesthonest too")
    codec.may_decode.set()
    loop.run_until(lambda: len(heard) == 5)

    assert codec.decoded == [b"first", b"honest", b"honest too", b"suspect", b"worst"]
    assert decoder.unread_bytes == 0
