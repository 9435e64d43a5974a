"""Topics reach the clients of the other workers of a server, and a slow worker delays nobody."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest
from fakes import FakeLog, FakeLoop

from rse_pf.backend.rosbridge.peers import WorkerPeers, peer_channels

KEY = ("default", "chat")


class Peer:
    """One worker's end, and what it heard."""

    def __init__(self, peers: WorkerPeers) -> None:
        self.peers = peers
        self.heard: list[bytes] = []
        self.wanted: list[tuple[str, str]] = []

    def begin(self) -> None:
        self.peers.begin(on_message=lambda key, data: self.heard.append(data), on_wanted=self.wanted.append)

    def wants(self, *, wanted: bool = True, exists: bool = True) -> None:
        self.peers.tell(KEY, "std_msgs/String", exists=exists, is_wanted=wanted)


@pytest.fixture
def started() -> Iterator[tuple[FakeLoop, Callable[[int], list[Peer]]]]:
    loop = FakeLoop()
    ends: list[int] = []
    peers: list[Peer] = []

    def start(count: int) -> list[Peer]:
        for index, (read, writes) in enumerate(channels := peer_channels(count)):
            # Each worker is a process of its own, which has every descriptor.
            own = tuple(os.dup(fd) if number != index else fd for number, fd in enumerate(writes))
            peers.append(Peer(WorkerPeers((read, own), index, loop=loop, log=FakeLog())))  # type: ignore[arg-type]
        ends.extend(channels[0][1])
        return peers

    yield loop, start
    for peer in peers:
        peer.peers.close()
    for each in ends:
        os.close(each)


def test_a_message_goes_to_who_wants_its_topic(started):
    loop, start = started
    a, b, c = start(3)
    for each in (a, b, c):
        each.begin()
    b.wants()
    c.wants(wanted=False)
    loop.turn()
    a.peers.publish(KEY, b"1")
    loop.turn()

    assert (a.heard, b.heard, c.heard) == ([], [b"1"], [])
    assert a.wanted == [KEY], "so that it sends what is latched"
    assert a.peers.topics("default") == {"chat": "std_msgs/String"}
    assert a.peers.topics("other") == {}


def test_a_topic_that_is_gone_is_neither_listed_nor_sent(started):
    loop, start = started
    a, b = start(2)
    for each in (a, b):
        each.begin()
    b.wants()
    b.wants(exists=False, wanted=False)
    loop.turn()
    a.peers.publish(KEY, b"1")
    loop.turn()

    assert b.heard == []
    assert a.peers.topics("default") == {}


def test_a_worker_that_does_not_read_gets_the_newest_message_later(started):
    loop, start = started
    a, b = start(2)
    a.begin()
    b.wants()
    loop.turn()
    large = [bytes([k]) * 100_000 for k in range(100)]
    for each in large:
        a.peers.publish(KEY, each)
    assert a.peers.dropped > 0
    b.begin()
    loop.advance(0.1)
    while loop.turn():
        loop.advance(0.05)

    assert b.heard[0] == large[0]
    assert b.heard[-1] == large[-1]
    assert len(b.heard) < len(large)


def test_the_longest_message_of_a_robot_fits_between_workers(started):
    loop, start = started
    a, b = start(2)
    for each in (a, b):
        each.begin()
    b.wants()
    loop.turn()
    a.peers.publish(KEY, b"x" * 262_144)
    loop.advance(0.05)

    assert [len(each) for each in b.heard] == [262_144]
