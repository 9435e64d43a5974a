"""After an outage: one frame first, the newest, and more as answers come."""

from __future__ import annotations

import pytest

from rse_pf.wire import Failure, Result
from rse_pf.wire.client_session import ClientSession, ConnectionState
from rse_pf.wire.rate_limit import Backlog, is_long_outage, send_order
from tests.kit.client_sessions import CODEC, commands, make_session, open_connection

ROOM = 8


def sent_ids(connection: ConnectionState) -> list[int]:
    """Return and forget which commands went out on *connection*."""
    return [command.id for command in commands(connection)]


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
    session.close_connection(open_connection(session))
    waited = old_frames(session, count)
    return session, open_connection(session, 1.0), waited


def test_after_an_outage_only_the_newest_frame_is_sent_first():
    _, connection, waited = back_with(20)

    assert sent_ids(connection) == [waited[-1]]


def test_every_answer_allows_one_more_frame_and_the_newest_is_sent_first():
    session, connection, waited = back_with(20)
    (first,) = sent_ids(connection)

    answer(session, connection, first, 1.1)
    second = sent_ids(connection)
    answer(session, connection, second[0], 1.2)

    assert second == [waited[18], waited[17]]
    assert sent_ids(connection) == [waited[16], waited[15]]


def test_a_fresh_frame_is_sent_before_waiting_ones():
    session, connection, waited = back_with(20)
    (first,) = sent_ids(connection)
    (fresh,) = frames(session, 1, now=1.05)
    assert sent_ids(connection) == []

    answer(session, connection, first, 1.1)

    assert sent_ids(connection) == [fresh, waited[18]]


@pytest.mark.parametrize("told", [{"code": "busy"}, {"code": "expired"}, {"queue_ms": 400.0}])
def test_a_loaded_server_receives_one_frame_at_a_time_again(told):
    session, connection, _ = back_with(20)
    answer(session, connection, *sent_ids(connection), 1.1)
    under_way = sent_ids(connection)
    assert len(under_way) == 2

    answer(session, connection, under_way[0], 1.2, **told)
    assert sent_ids(connection) == []
    answer(session, connection, under_way[1], 1.3, **told)
    session.due(1.361)  # after the pause that a busy answer asks for

    assert len(sent_ids(connection)) == 1


def test_the_backlog_ends_when_no_waiting_frame_is_left():
    session, connection, waited = back_with(3)
    assert sent_ids(connection) == [waited[2]]
    fresh = frames(session, ROOM, now=4.5)
    assert sent_ids(connection) == []

    session.due(5.6)

    assert connection.backlog is None
    assert sent_ids(connection) == fresh


def test_all_waiting_frames_are_sent_and_then_frames_go_as_they_come():
    session, connection, waited = back_with(20)
    seen, now = [], 1.0
    while under_way := sent_ids(connection):
        seen += under_way
        assert len(under_way) <= ROOM
        for identity in under_way:
            now += 0.01
            answer(session, connection, identity, now)

    assert sorted(seen) == waited
    fresh = frames(session, 3, now=now)
    assert sent_ids(connection) == fresh


def test_commands_without_a_stream_keep_their_order_and_wait_for_no_frame():
    session = make_session()
    session.close_connection(open_connection(session))
    old = old_frames(session, 5)
    calls = [session.submit("merge", None, now=0.0) for _ in range(3)]

    assert sent_ids(open_connection(session, 1.0)) == [*calls, old[-1]]


def test_a_command_without_a_deadline_does_not_hold_frames_back():
    session = make_session()
    session.close_connection(open_connection(session))
    old = old_frames(session, 3)
    endless = session.submit("map", None, now=0.0, stream="map", keep=True, is_open_ended=True)

    assert sent_ids(open_connection(session, 1.0)) == [endless, old[-1]]


def test_a_frame_that_expires_in_flight_allows_the_next_one():
    session, connection, waited = back_with(4)
    assert sent_ids(connection) == [waited[3]]
    (fresh,) = frames(session, 1, now=4.0)

    session.due(5.5)

    assert sent_ids(connection) == [fresh]


@pytest.mark.parametrize(("outage_s", "at_once"), [(2.4, 6), (2.6, 1)])
def test_after_a_short_outage_frames_are_sent_in_their_order(outage_s, at_once):
    """A server that died is replaced by its neighbour within a second or two: the frames are still young."""
    session = make_session()
    session.close_connection(open_connection(session))
    waited = frames(session, 6)

    sent = sent_ids(open_connection(session, outage_s))

    assert sent == (waited if at_once > 1 else [waited[-1]])


def test_a_move_to_another_server_is_no_outage():
    session = make_session()
    open_connection(session)
    frames(session, ROOM + 4)

    assert len(sent_ids(open_connection(session, 0.1))) == 4


def test_frames_are_ordered_newest_first_behind_commands_without_a_stream():
    waiting = [(1, "pose"), (2, ""), (3, "map"), (4, ""), (5, "pose")]

    assert sorted(waiting, key=lambda each: send_order(*each)) == [
        (2, ""), (4, ""), (5, "pose"), (3, "map"), (1, "pose"),
    ]  # fmt: skip
    assert Backlog(newest=5).max_in_flight == 1
    assert [is_long_outage(2.0, 6.0, now_s) for now_s in (2.0, 4.0, 4.1)] == [False, False, True]
