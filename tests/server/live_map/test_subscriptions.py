"""Which robot gets which update of a live map, and how much memory a slow one takes."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from rse_pf.errors import Forbidden, RsePfError
from rse_pf.server.live_map.subscriptions import Subscriptions
from rse_pf.wire import Failure, Update
from tests.kit.fake_map_client import FakeReader
from tests.kit.fakes import FakeLog, FakeLoop


class Parts:
    def __init__(self) -> None:
        self.loop = FakeLoop()
        self.log = FakeLog()
        self.watched: list[tuple[str, str]] = []
        self.all = Subscriptions(
            loop=self.loop,  # type: ignore[arg-type]
            log=self.log,
            watch=lambda tenant, name, may_start: self.watched.append((tenant, name)),
            unwatch=lambda *key: self.watched.remove(key),
        )

    def begin(self, reader: FakeReader, identity: int = 7, name: str = "m", **more: Any) -> None:
        more.setdefault("find_error", lambda: None)
        self.all.begin(reader, identity, reader.robot.tenant, name, **more)

    def pose(self, robot: str, x: float, *, tenant: str = "default") -> None:
        self.all.update(tenant, "m", f"pose/{robot}", {"kind": "pose", "robot": robot, "x": x})

    def settle(self) -> None:
        self.loop.advance(1.0)


@pytest.fixture
def parts() -> Parts:
    return Parts()


def received(reader: FakeReader) -> list[tuple[int, str]]:
    return [(update.seq, update.key) for update in reader.written if isinstance(update, Update)]


def poses(reader: FakeReader) -> list[float]:
    return [update.payload["x"] for update in reader.written if update.key != "map"]


def test_a_slow_reader_gets_the_newest_value_of_each_key_and_a_gap_in_the_numbers(parts: Parts) -> None:
    slow, fast = FakeReader("slow"), FakeReader("fast")
    parts.begin(slow)
    parts.begin(fast)
    parts.settle()
    slow.unsent_bytes = 1 << 20

    for step in range(100):
        parts.pose("a", float(step))
        parts.pose("b", float(-step))
        parts.settle()
    slow.unsent_bytes = 0
    parts.settle()

    assert received(slow)[1:] == [(101, "pose/a"), (201, "pose/b")]
    assert poses(slow) == [99.0, -99.0]
    assert len(poses(fast)) == 200
    assert parts.all.replaced == 198


def test_a_reader_that_never_reads_costs_the_names_of_the_keys_only(parts: Parts) -> None:
    reader = FakeReader()
    parts.begin(reader)
    parts.settle()
    reader.unsent_bytes = 1 << 20
    [subscription] = parts.all._by_subscriber[reader].values()  # type: ignore[index]

    for step in range(3000):
        parts.pose(f"robot-{step % 1500}", float(step))
    parts.settle()

    assert received(reader) == [(1, "map")]
    assert len(subscription.map.updates) == 1024
    assert len(subscription.unsent) <= 1024
    assert sys.getsizeof(subscription.unsent) < 100_000


def test_another_tenants_map_of_the_same_name_is_another_map(parts: Parts) -> None:
    here, there = FakeReader("r"), FakeReader("r", tenant="other")
    parts.begin(here)
    parts.begin(there)

    parts.pose("a", 1.0, tenant="other")
    parts.settle()

    assert poses(here) == []
    assert poses(there) == [1.0]


def test_a_reader_that_is_slow_when_it_leaves_is_forgotten(parts: Parts) -> None:
    reader = FakeReader()
    parts.begin(reader)
    parts.settle()
    reader.unsent_bytes = 1 << 20
    parts.pose("a", 1.0)
    parts.settle()

    parts.all.end_all(reader)
    reader.unsent_bytes = 0
    parts.settle()

    assert poses(reader) == []


def test_a_robot_whose_right_ends_gets_an_error_and_no_further_update(parts: Parts) -> None:
    reader = FakeReader()
    wrong: list[RsePfError] = []
    parts.begin(reader, find_error=lambda: wrong[0] if wrong else None)
    parts.settle()

    wrong.append(Forbidden("no more"))
    parts.pose("a", 1.0)
    parts.settle()

    assert isinstance(reader.written[-1], Failure)
    assert (reader.written[-1].id, reader.written[-1].code) == (7, "forbidden")
    assert received(reader) == [(1, "map")]
    assert parts.watched == []


@pytest.mark.parametrize("value", [object(), "x" * 70_000])
def test_a_value_that_cannot_be_sent_is_logged_once_and_left_out(parts: Parts, value: object) -> None:
    readers = [FakeReader("a"), FakeReader("b")]
    for reader in readers:
        parts.begin(reader)

    parts.all.update("default", "m", "odd", {"value": value})
    parts.pose("a", 1.0)
    parts.settle()

    assert [[key for _, key in received(reader)] for reader in readers] == [["map", "pose/a"]] * 2
    assert [fields["key"] for level, _, fields in parts.log.events if level == "error"] == ["odd"]
