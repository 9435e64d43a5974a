"""A connection keeps the order of its messages, whichever of them the decoder thread gets."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import pytest
from msgspec import Raw

from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.wire import Command, Failure, Ping, Pong, Result, make_codec
from tests.kit.fakes import FakeWire
from tests.kit.worker_parts import WorkerParts, worker_parts

SETTINGS = PlatformSettings()
CODEC = make_codec("zlib")
BOMB = zlib.compress(bytes(3_000_000), 9)
LONG = CODEC.encode(Command(id=7, service="echo", payload={"value": list(range(20_000))}))
PAUSE_S = 0.1


@pytest.fixture
def worker() -> Iterator[WorkerParts]:
    with worker_parts(codec="zlib") as parts:
        yield parts


def short(number: int) -> Command:
    return Command(id=number, service="echo", payload={"value": 1.5})


def answered(wire: FakeWire) -> list[int | None]:
    return [message.id for message in wire.sent if isinstance(message, (Result, Failure))]


def test_messages_behind_a_long_one_wait_for_it_and_the_socket_is_not_read_meanwhile(worker: WorkerParts):
    connection, wire = worker.join()

    for message in (LONG, short(8), LONG, Ping(sent_s=1.0)):
        worker.say(connection, message)
    assert (answered(wire), wire.holds) == ([], 1)
    worker.loop.run_until(lambda: any(isinstance(message, Pong) for message in wire.sent))
    worker.loop.run_until(lambda: len(answered(wire)) == 3)

    assert answered(wire) == [7, 8, 7]
    assert wire.holds == 0


def test_a_small_bomb_is_inflated_by_the_thread_and_its_robot_is_read_more_rarely(worker: WorkerParts):
    connection, wire = worker.join()
    assert len(BOMB) < worker.decoder.short_bytes

    worker.say(connection, BOMB)
    assert answered(wire) == []
    worker.loop.run_until(lambda: answered(wire))

    assert wire.sent[-1].code == "too-large"
    assert wire.pauses == [PAUSE_S]


def test_three_long_bombs_close_the_connection_and_ban_the_robot(worker: WorkerParts):
    connection, wire = worker.join()
    limits, rates = SETTINGS.session, worker.admission.rates
    bomb = zlib.compress(bytes(300_000_000), 9)[: limits.max_message_bytes]
    assert len(bomb) == limits.max_message_bytes

    for number in range(3):
        assert wire.closed is None
        assert rates.banned_s(connection.robot, worker.loop.now) == 0
        worker.say(connection, bomb)
        worker.loop.run_until(lambda: len(answered(wire)) > number)  # noqa: B023  it is called at once

    assert wire.closed == (4400, "too many bad messages")
    assert wire.pauses == pytest.approx([5 * PAUSE_S, 10 * PAUSE_S])
    assert rates.banned_s(connection.robot, worker.loop.now) == 5.0
    assert rates.banned_s(RobotId("default", "r2"), worker.loop.now) == 0


def test_a_long_message_that_finds_the_decoder_full_is_refused_with_its_id():
    with worker_parts(codec="zlib", settings=SETTINGS) as worker:
        connection, wire = worker.join()
        worker.decoder.begin = lambda *_, **__: None  # type: ignore[method-assign]
        worker.decoder.unread_bytes = 1 << 24
        worker.say(connection, LONG)

    (refusal,) = [message for message in wire.sent if isinstance(message, Failure)]
    assert (refusal.id, refusal.code) == (7, "busy")
    assert refusal.retry_after_ms > 0
    assert worker.metrics.shed["unread"] == 1


UNDECODABLE = CODEC.encode(Command(id=7, service="echo", payload=Raw(b"[1,NaN]")))


def test_commands_that_cannot_be_decoded_are_answered_and_the_next_valid_one_works(worker: WorkerParts):
    connection, wire = worker.join()
    assert connection.session is not None

    for _ in range(14):
        worker.say(connection, UNDECODABLE)
    worker.say(connection, short(8))

    assert [(each.id, each.code) for each in wire.sent if isinstance(each, Failure)] == [
        (7, "bad-message")
    ] * 14
    assert answered(wire)[-1] == 8
    assert (wire.closed, connection.session.in_flight) == (None, 0)
    assert wire.pauses == pytest.approx([0.1, 0.2, 0.3, 0.4] + [0.5] * 10)
    assert worker.admission.rates.banned_s(connection.robot, worker.loop.now) == 0
    assert worker.metrics.requests["unknown", "bad-message"] == 14
