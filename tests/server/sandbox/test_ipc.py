"""Messages and printed lines between a worker and a sandbox, over real sockets."""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Any

import pytest

from rse_pf.errors import BadMessage, LimitExceeded
from rse_pf.processes.ipc import FrameReader, encode_message, encode_reply, receive
from rse_pf.server.sandbox.channel import IpcChannel
from tests.kit.fakes import FakeLoop

MESSAGES: list[Any] = [["ready"], [True, {"count": 1}, b"\x00\x01", 1.5], []]


def framed(body: bytes) -> bytes:
    return len(body).to_bytes(4, "little") + body


def test_messages_are_the_same_however_the_stream_is_cut():
    stream = b"".join(map(encode_message, MESSAGES))

    for size in range(1, len(stream) + 1):
        reader = FrameReader(1000)
        pieces = [stream[start : start + size] for start in range(0, len(stream), size)]
        assert [message for piece in pieces for message in reader.feed(piece)] == MESSAGES


def test_a_message_above_the_limit_is_refused_by_its_header():
    with pytest.raises(LimitExceeded):
        list(FrameReader(10).feed((11).to_bytes(4, "little")))


@pytest.mark.parametrize(
    "body",
    [
        b"\x91" * 1_000_000,
        b"\x91" * 1001 + b"\x01",
        b"\xdd\x00\x0f\x00\x00" + b"\x90" * 0xF0000,
        b"\xdd\x00\x07\x00\x00" + b"\xa1a" * 0x70000,
        b"\xdd\x7f\xff\xff\xff" + b"\x01" * 100_000,
        b"\x94\xc3\xc0\xc0\xc7\x03\x01abc",
        b"\x94\xc3\xc0\xc0\xd4\x77a",
    ],
)
def test_a_body_that_is_expensive_or_damaged_is_refused_with_a_typed_error(body):
    with pytest.raises((BadMessage, LimitExceeded)):
        list(FrameReader(1 << 20).feed(framed(body)))


@pytest.mark.parametrize("reply", [[1.5] * 100_000, list(range(100)) * 1000, {"a": [[1, 2]] * 3000}])
def test_a_reply_of_flat_lists_may_be_long(reply):
    message = [True, reply, None, 1.5]

    assert list(FrameReader(1 << 20).feed(encode_reply(message))) == [message]


@pytest.mark.parametrize("reply", [[[1]] * 8000, ["a", 1] * 20_000, [1.5] * 200_000])
def test_a_sandbox_sees_by_itself_that_its_reply_would_be_refused(reply):
    with pytest.raises(LimitExceeded):
        encode_reply([True, reply, None, 1.5])


def test_a_blocking_receiver_gets_each_message_and_none_at_the_end():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        for message in MESSAGES:
            theirs.sendall(encode_message(message))
        theirs.sendall(b"\x05\x00\x00\x00ab")
        theirs.shutdown(socket.SHUT_WR)

        assert [receive(ours) for _ in MESSAGES] == MESSAGES
        assert receive(ours) is None, "a message that was cut off"


class Peer:
    """A channel with the sandbox's ends in the hands of the test."""

    def __init__(self, max_bytes: int = 1000, stops_after: int = 1000) -> None:
        self.stops_after = stops_after
        self.loop = FakeLoop()
        self.messages: list[Any] = []
        self.faults: list[str] = []
        self.lines: list[str] = []
        self.channel = IpcChannel(
            self.loop, max_bytes=max_bytes, on_message=self.take, on_fault=self.faults.append,
            on_line=self.lines.append,
        )  # fmt: skip
        self.socket, self.output = self.channel.theirs.dup(), os.dup(self.channel.their_output)
        self.channel.start()

    def take(self, message: Any) -> None:
        self.messages.append(message)
        if len(self.messages) == self.stops_after:
            self.channel.stop_reading()

    def close(self) -> None:
        self.channel.close()
        self.socket.close()
        os.close(self.output)


@pytest.fixture
def peer():
    peer = Peer()
    yield peer
    peer.close()


def test_a_large_message_to_a_sandbox_that_does_not_read_waits_without_blocking(peer):
    peer.channel.send(encode_message(bytes(1 << 22)))
    peer.socket.setblocking(False)
    received = bytearray()

    def read_some() -> bool:
        with contextlib.suppress(BlockingIOError):
            received.extend(peer.socket.recv(1 << 16))
        return len(received) > 1 << 22

    peer.loop.run_until(read_some)

    assert received == encode_message(bytes(1 << 22))


@pytest.mark.parametrize("sent", [b"\xff\xff\xff\x7f", b"\x01\x00\x00\x00\xc1"])
def test_an_invalid_message_is_reported_once_and_nothing_is_read_after_it(peer, sent):
    peer.socket.sendall(sent)
    peer.loop.run_until(lambda: peer.faults)
    peer.socket.sendall(encode_message(["more"]))
    peer.loop.advance(1.0)

    assert len(peer.faults) == 1
    assert "invalid message" in peer.faults[0]
    assert peer.messages == []


def test_a_flood_of_messages_ends_with_the_one_after_which_the_channel_stops_reading():
    peer = Peer(stops_after=2)
    peer.socket.sendall(encode_message(["ready"]) * 1000)
    peer.loop.run_until(lambda: peer.messages)
    peer.socket.sendall(encode_message(["more"]))
    peer.loop.advance(1.0)
    peer.close()

    assert peer.messages == [["ready"]] * 2
    assert peer.faults == []


def test_printed_lines_are_passed_on_with_limits_of_length_and_number(peer):
    os.write(peer.output, b"x" * 1000 + b"\n" + b"line\n" * 500)
    peer.loop.run_until(lambda: peer.lines)

    assert peer.lines[0].endswith("x [784 characters more]")
    assert len(peer.lines) == 200


def test_closing_reads_what_was_printed_last(peer):
    os.write(peer.output, b"last words\nand a begun line")
    peer.channel.close()

    assert peer.lines == ["last words", "and a begun line"]
