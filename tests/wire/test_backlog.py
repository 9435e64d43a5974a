"""After an outage: one frame first, the newest, and more as answers come."""

from __future__ import annotations

import pytest

from rse_pf.config import SessionSettings
from rse_pf.wire import Command, Failure, Limits, Result, Welcome, make_codec
from rse_pf.wire.client_session import ClientSession, ConnectionState
from rse_pf.wire.rate_limit import Backlog, is_long_outage, send_order

CODEC = make_codec("json")
ROOM = 8


def make_session() -> ClientSession:
    return ClientSession(codec=CODEC, settings=SessionSettings(), sdk="test")


def welcomed(session: ClientSession, now: float = 0.0) -> ConnectionState:
    connection = session.open_connection(now)
    limits = Limits(max_message_bytes=4096, max_in_flight=ROOM)
    welcome = Welcome(server="a", session="s", robot="r", protocol=1, clock_s=now, limits=limits)
    session.receive(connection, CODEC.encode(welcome), now)
    session.adopt(connection, now)
    return connection


def commands(connection: ConnectionState) -> list[int]:
    """Return and forget which commands went out on *connection*."""
    messages = [CODEC.decode_from_robot(data) for data in connection.outgoing]
    connection.outgoing.clear()
    return [message.id for message in messages if isinstance(message, Command)]


def answer(
    session: ClientSession,
    connection: ConnectionState,
    identity: int,
    now: float,
    code: str = "",
    queue_ms: float = 3.0,
) -> None:
    message: Result | Failure = Result(id=identity, reply=None, queue_ms=queue_ms)
    if code:
        message = Failure(id=identity, code=code, message="", retry_after_ms=60.0)
    session.receive(connection, CODEC.encode(message), now)


def frames(session: ClientSession, count: int, now: float = 0.0) -> list[int]:
    return [session.submit("pnp", None, now=now, stream="pose", keep=True) for _ in range(count)]


def old_frames(session: ClientSession, count: int) -> list[int]:
    """Frames whose time ends at 5 s, of which two thirds are over at 1 s."""
    return [
        session.submit("pnp", None, now=-7.0, deadline_s=12.0, stream="pose", keep=True) for _ in range(count)
    ]


def back_with(count: int) -> tuple[ClientSession, ConnectionState, list[int]]:
    """Return a session whose connection came back after *count* frames had waited for one."""
    session = make_session()
    session.close_connection(welcomed(session))
    waited = old_frames(session, count)
    return session, welcomed(session, 1.0), waited


def test_after_an_outage_only_the_newest_frame_is_sent_first():
    _, connection, waited = back_with(20)

    assert commands(connection) == [waited[-1]]


def test_every_answer_allows_one_more_frame_and_the_newest_is_sent_first():
    session, connection, waited = back_with(20)
    (first,) = commands(connection)

    answer(session, connection, first, 1.1)
    second = commands(connection)
    answer(session, connection, second[0], 1.2)

    assert second == [waited[18], waited[17]]
    assert commands(connection) == [waited[16], waited[15]]


def test_a_fresh_frame_is_sent_before_waiting_ones():
    session, connection, waited = back_with(20)
    (first,) = commands(connection)
    (fresh,) = frames(session, 1, now=1.05)
    assert commands(connection) == []

    answer(session, connection, first, 1.1)

    assert commands(connection) == [fresh, waited[18]]


@pytest.mark.parametrize("told", [{"code": "busy"}, {"code": "expired"}, {"queue_ms": 400.0}])
def test_a_loaded_server_receives_one_frame_at_a_time_again(told):
    session, connection, _ = back_with(20)
    answer(session, connection, *commands(connection), 1.1)
    under_way = commands(connection)
    assert len(under_way) == 2

    answer(session, connection, under_way[0], 1.2, **told)
    assert commands(connection) == []
    answer(session, connection, under_way[1], 1.3, **told)
    session.due(1.361)  # after the pause that a busy answer asks for

    assert len(commands(connection)) == 1


def test_the_backlog_ends_when_no_waiting_frame_is_left():
    session, connection, waited = back_with(3)
    assert commands(connection) == [waited[2]]
    fresh = frames(session, ROOM, now=4.5)
    assert commands(connection) == []

    session.due(5.6)

    assert connection.backlog is None
    assert commands(connection) == fresh


def test_all_waiting_frames_are_sent_and_then_frames_go_as_they_come():
    session, connection, waited = back_with(20)
    seen, now = [], 1.0
    while under_way := commands(connection):
        seen += under_way
        assert len(under_way) <= ROOM
        for identity in under_way:
            now += 0.01
            answer(session, connection, identity, now)

    assert sorted(seen) == waited
    fresh = frames(session, 3, now=now)
    assert commands(connection) == fresh


def test_commands_without_a_stream_keep_their_order_and_wait_for_no_frame():
    session = make_session()
    session.close_connection(welcomed(session))
    old = old_frames(session, 5)
    calls = [session.submit("merge", None, now=0.0) for _ in range(3)]

    assert commands(welcomed(session, 1.0)) == [*calls, old[-1]]


def test_a_command_without_a_deadline_does_not_hold_frames_back():
    session = make_session()
    session.close_connection(welcomed(session))
    old = old_frames(session, 3)
    endless = session.submit("map", None, now=0.0, stream="map", keep=True, is_open_ended=True)

    assert commands(welcomed(session, 1.0)) == [endless, old[-1]]


def test_a_frame_that_expires_in_flight_allows_the_next_one():
    session, connection, waited = back_with(4)
    assert commands(connection) == [waited[3]]
    (fresh,) = frames(session, 1, now=4.0)

    session.due(5.5)

    assert commands(connection) == [fresh]


@pytest.mark.parametrize("waited", [0, 1])
def test_without_a_backlog_nothing_is_held_back(waited):
    session, connection, old = back_with(waited)

    assert commands(connection) == old
    assert connection.backlog is None
    assert commands_of(session, connection, 5) == 5


def commands_of(session: ClientSession, connection: ConnectionState, count: int) -> int:
    frames(session, count, now=1.1)
    return len(commands(connection))


@pytest.mark.parametrize(("outage_s", "at_once"), [(2.4, 6), (2.6, 1)])
def test_after_a_short_outage_frames_are_sent_in_their_order(outage_s, at_once):
    """A server that died is replaced by its neighbour within a second or two: the frames are still young."""
    session = make_session()
    session.close_connection(welcomed(session))
    waited = frames(session, 6)

    sent = commands(welcomed(session, outage_s))

    assert sent == (waited if at_once > 1 else [waited[-1]])


def test_a_move_to_another_server_is_no_outage():
    session = make_session()
    welcomed(session)
    frames(session, ROOM + 4)

    assert len(commands(welcomed(session, 0.1))) == 4


def test_frames_are_ordered_newest_first_behind_commands_without_a_stream():
    waiting = [(1, "pose"), (2, ""), (3, "map"), (4, ""), (5, "pose")]

    assert sorted(waiting, key=lambda each: send_order(*each)) == [
        (2, ""), (4, ""), (5, "pose"), (3, "map"), (1, "pose"),
    ]  # fmt: skip
    assert Backlog(newest=5).max_in_flight == 1
    assert [is_long_outage(2.0, 6.0, now_s) for now_s in (2.0, 4.0, 4.1)] == [False, False, True]
