"""The robot's rules: one final answer per command, whatever happens to the connections."""

from __future__ import annotations

import math

import pytest

from rse_pf.errors import BadMessage, LimitExceeded, ProtocolError
from rse_pf.wire import Command, Failure, Hello, Move, Ping, Pong, Result, make_codec
from rse_pf.wire.client_session import (
    RETRY_SHARE,
    ClientSession,
    ConnectionLost,
    ConnectionState,
    MoveRequested,
)
from tests.kit.client_sessions import SETTINGS, codes, commands, make_session, open_connection, sent, tell


def result(command: Command, **stamps: float) -> Result:
    return Result(id=command.id, reply=command.seq, server="a", **stamps)


def failure(command: Command, code: str, **more) -> Failure:
    return Failure(id=command.id, code=code, message=code, **more)


def tend_until_lost(session: ClientSession, connection: ConnectionState) -> tuple[float, list]:
    """Return when an unanswering *connection* was given up, and what the session said then."""
    now, events = 0.0, []
    while not events:
        now = session.next_due(now)
        events = session.check(connection, now)
    return now, events


def test_a_connection_begins_with_hello():
    (hello,) = sent(make_session().open_connection(0.0))

    assert hello == Hello(sdk="test", capabilities=("move", "progress", "updates"))


def test_a_command_waits_for_a_connection_and_is_sent_with_its_remaining_time():
    session = make_session()
    session.submit("pnp", {"x": 1}, now=0.0, deadline_s=1.0)

    connection = open_connection(session, now=0.4)

    (command,) = commands(connection)
    assert command.deadline_ms == pytest.approx(600.0)
    assert session.resent == 0


def test_an_answer_ends_its_command_once_and_a_duplicate_is_dropped():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("pnp", None, now=0.0)
    (command,) = commands(connection)

    first = tell(session, connection, result(command), 0.1)
    second = tell(session, connection, result(command), 0.2)

    assert codes(first) == {identity: "ok"}
    assert second == []
    assert (session.dropped_answers, session.unanswered) == (1, 0)


def test_commands_of_a_lost_connection_are_sent_on_the_next_under_the_same_id():
    session = make_session()
    first = open_connection(session)
    ids = [session.submit("pnp", None, now=0.0) for _ in range(3)]
    commands(first)

    session.close_connection(first)
    second = open_connection(session, now=0.5, server="b")

    assert [command.id for command in commands(second)] == ids
    assert session.resent == 3


def test_of_a_latest_wins_stream_only_the_newest_frame_is_sent_again():
    session = make_session()
    connection = open_connection(session)
    old, new = (session.submit("pnp", None, now=0.0, stream="pose") for _ in range(2))
    session.close_connection(connection)

    fresh = session.open_connection(1.0)
    events = session.adopt(fresh, 1.0)

    assert codes(events) == {old: "stale"}
    assert [command.id for command in commands(fresh)] == [new]


def test_after_a_long_outage_there_is_no_catch_up_burst():
    session = make_session()
    connection = open_connection(session)
    session.close_connection(connection)
    for step in range(100):
        session.submit("pnp", None, now=step * 0.01, stream="pose", deadline_s=5.0)

    assert [command.seq for command in commands(open_connection(session, now=1.0))] == [100]


def test_an_older_answer_than_the_last_delivered_one_is_stale():
    session = make_session()
    connection = open_connection(session)
    for _ in range(2):
        session.submit("pnp", None, now=0.0, stream="pose")
    older, newer = commands(connection)

    assert codes(tell(session, connection, result(newer), 0.1)) == {newer.id: "ok"}
    assert codes(tell(session, connection, result(older), 0.2)) == {older.id: "stale"}


def test_streams_do_not_make_each_other_stale():
    session = make_session()
    connection = open_connection(session)
    for stream in ("left", "left", "right"):
        session.submit("pnp", None, now=0.0, stream=stream)
    _, newer, other = commands(connection)

    tell(session, connection, result(newer), 0.1)

    assert codes(tell(session, connection, result(other), 0.2)) == {other.id: "ok"}


def test_an_unanswered_command_expires_at_its_deadline_and_not_before():
    session = make_session()
    open_connection(session)
    identity = session.submit("pnp", None, now=0.0, deadline_s=0.5)

    assert session.due(0.499) == []
    assert codes(session.due(0.5)) == {identity: "expired"}
    assert session.next_due(0.0) <= 0.5


def test_a_robot_sends_no_more_commands_than_the_server_accepts():
    session = make_session()
    connection = open_connection(session, room=2)
    for _ in range(5):
        session.submit("pnp", None, now=0.0)
    first, second = commands(connection)

    tell(session, connection, result(first), 0.1)

    assert [command.id for command in commands(connection)] == [second.id + 1]
    assert session.unanswered == 4


def test_busy_is_retried_after_the_servers_pause():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0, deadline_s=1.0)
    (command,) = commands(connection)

    assert tell(session, connection, failure(command, "busy", retry_after_ms=200), 0.1) == []
    session.due(0.29)
    assert commands(connection) == []
    assert session.next_due(0.1) == pytest.approx(0.3)
    session.due(0.31)

    assert [again.id for again in commands(connection)] == [command.id]


def test_a_new_connection_respects_the_pause_of_a_busy_answer():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0)
    (command,) = commands(connection)
    tell(session, connection, failure(command, "busy", retry_after_ms=500), 0.0)

    assert commands(open_connection(session, now=0.1, server="b")) == []


def test_busy_beyond_the_deadline_is_final():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0, deadline_s=0.2)
    (command,) = commands(connection)

    events = tell(session, connection, failure(command, "busy", retry_after_ms=200), 0.1)

    assert codes(events) == {command.id: "busy"}


def test_retries_after_busy_stay_within_their_budget():
    session = make_session()
    connection = open_connection(session, room=1)
    retries = final = 0
    for _ in range(400):
        session.submit("pnp", None, now=0.0, deadline_s=9.0)
        (command,) = commands(connection)
        while not (events := tell(session, connection, failure(command, "busy", retry_after_ms=0), 0.0)):
            retries += 1
            (command,) = commands(connection) or (session.due(0.0) or commands(connection))
        final += codes(events) == {command.id: "busy"}

    assert final == 400
    assert retries <= 5 + 400 * RETRY_SHARE + 1
    assert retries >= 400 * RETRY_SHARE


def test_a_command_of_a_lost_worker_is_retried_twice():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0)

    for _ in range(2):
        (command,) = commands(connection)
        assert tell(session, connection, failure(command, "worker-lost"), 0.1) == []
    (command,) = commands(connection)

    assert codes(tell(session, connection, failure(command, "worker-lost"), 0.2)) == {
        command.id: "worker-lost"
    }


def test_a_failure_on_a_former_connection_is_dropped_but_a_result_is_accepted():
    session = make_session()
    old = open_connection(session)
    session.submit("pnp", None, now=0.0)
    (command,) = commands(old)
    session.close_connection(old)
    open_connection(session, now=0.1, server="b")

    assert tell(session, old, failure(command, "internal"), 0.2) == []
    assert codes(tell(session, old, result(command), 0.3)) == {command.id: "ok"}


def test_a_move_leaves_unanswered_commands_on_the_old_connection():
    session = make_session()
    old = open_connection(session)
    session.submit("pnp", None, now=0.0)
    (command,) = commands(old)

    assert tell(session, old, Move(reason="drain", within_ms=2000), 0.1) == [MoveRequested("drain", 2.0)]
    new = open_connection(session, now=0.2, server="b")
    session.submit("pnp", None, now=0.3)

    assert old.leaving
    assert session.unanswered_on(old) == 1
    assert len(commands(new)) == 1
    assert codes(tell(session, old, result(command), 0.4)) == {command.id: "ok"}
    assert session.unanswered_on(old) == 0


def test_a_cancelled_command_is_forgotten_and_never_resent():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("pnp", None, now=0.0)
    (command,) = commands(connection)

    session.cancel(identity)
    assert session.unanswered == 0
    assert tell(session, connection, result(command), 0.1) == []
    session.close_connection(connection)

    assert commands(open_connection(session, now=1.0)) == []


def test_a_command_cancelled_in_flight_is_not_sent_again_when_its_connection_is_lost():
    session = make_session()
    connection = open_connection(session)
    session.cancel(session.submit("pnp", None, now=0.0))
    commands(connection)

    session.close_connection(connection)

    assert commands(open_connection(session, now=1.0)) == []


def test_a_cancelled_command_counts_as_in_flight_until_the_server_answered():
    session = make_session()
    connection = open_connection(session, room=1)
    session.cancel(session.submit("pnp", None, now=0.0))
    (first,) = commands(connection)
    session.submit("pnp", None, now=0.0)
    assert commands(connection) == []

    tell(session, connection, result(first), 0.1)

    assert len(commands(connection)) == 1


def test_a_stalled_connection_with_an_unanswered_command_is_lost_in_time():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0, deadline_s=60.0)

    now, events = tend_until_lost(session, connection)
    assert events == [ConnectionLost("silence")]
    assert now <= SETTINGS.stall_timeout_s + SETTINGS.stall_timeout_s / 3 + 1e-9
    assert session.current is None


def test_a_slow_command_is_no_stall_while_the_server_answers_pings():
    session = make_session()
    connection = open_connection(session)
    session.submit("merge", None, now=0.0, deadline_s=60.0)

    now = 0.0
    while now < 20.0:
        now = session.next_due(now)
        assert session.check(connection, now) == []
        for message in sent(connection):
            if isinstance(message, Ping):
                tell(session, connection, Pong(sent_s=message.sent_s, received_s=now, answered_s=now), now)


def test_a_command_after_a_long_idle_time_does_not_end_its_connection():
    session = make_session()
    connection = open_connection(session)
    session.check(connection, 0.0)
    tell(session, connection, Pong(sent_s=0.0, received_s=0.0, answered_s=0.0), 0.0)
    sent(connection)
    for tick in range(1, 6):
        session.check(connection, tick * 0.3)

    session.submit("merge", None, now=1.5, deadline_s=60.0)
    session.check(connection, 1.6)

    assert any(isinstance(message, Ping) for message in sent(connection))


def test_an_idle_connection_is_lost_when_its_ping_stays_unanswered():
    session = make_session()
    connection = open_connection(session)

    now, events = tend_until_lost(session, connection)
    assert events == [ConnectionLost("no pong")]
    assert now <= SETTINGS.ping_interval_s + SETTINGS.ping_timeout_s


def test_time_in_which_the_robot_did_not_run_is_no_stall_of_the_server():
    session = make_session()
    connection = open_connection(session)
    session.submit("pnp", None, now=0.0, deadline_s=60.0)
    session.check(connection, 0.3)

    assert session.check(connection, 5.0) == []


def test_a_connection_without_a_welcome_is_lost():
    session = make_session()
    connection = session.open_connection(0.0)

    now, events = tend_until_lost(session, connection)
    assert events == [ConnectionLost("no welcome")]
    assert now <= SETTINGS.hello_timeout_s + SETTINGS.stall_timeout_s


def test_pings_measure_the_offset_and_results_the_two_delays():
    session = make_session()
    connection = open_connection(session)
    tell(session, connection, Pong(sent_s=0.0, received_s=100.01, answered_s=100.01), 0.02)
    session.submit("pnp", None, now=1.0)
    (command,) = commands(connection)

    (event,) = tell(session, connection, result(command, received_s=101.03, sent_s=101.05), 1.06)

    assert (event.up_s, event.down_s) == (pytest.approx(0.03), pytest.approx(0.01))


def test_delays_add_up_to_the_time_on_the_network_and_are_never_negative():
    session = make_session()
    connection = open_connection(session)
    tell(session, connection, Pong(sent_s=0.0, received_s=100.05, answered_s=100.05), 0.1)
    session.submit("pnp", None, now=1.0)
    (command,) = commands(connection)

    (event,) = tell(session, connection, result(command, received_s=101.0, sent_s=101.0), 1.02)

    assert event.up_s == 0.0
    assert event.down_s == pytest.approx(0.02)


@pytest.mark.parametrize("sent_s", [-5.0, 1e9])
def test_a_pong_without_a_ping_does_not_change_the_clock_offset(sent_s):
    session = make_session()
    connection = open_connection(session)

    tell(session, connection, Pong(sent_s=sent_s, received_s=1e6, answered_s=1e6), 0.1)

    assert connection.clock_offset.offset_s is None


def test_results_without_timestamps_give_no_delays():
    session = make_session()
    connection = open_connection(session)
    tell(session, connection, Pong(sent_s=0.0, received_s=5.0, answered_s=5.0), 0.02)
    session.submit("pnp", None, now=1.0)
    (command,) = commands(connection)

    (event,) = tell(session, connection, result(command), 1.1)

    assert (event.up_s, event.down_s) == (None, None)


def test_an_invalid_message_is_a_protocol_error_and_affects_no_command():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("pnp", None, now=0.0)
    (command,) = commands(connection)

    for garbage in (b"", b"{", b'{"type":"welcome"}', b"\xff\xff", b'{"type":"result","id":"x"}'):
        with pytest.raises(ProtocolError):
            session.receive(connection, garbage, 0.1)

    assert codes(tell(session, connection, result(command), 0.2)) == {identity: "ok"}


def test_numbers_that_are_not_finite_in_a_move_or_pause_are_harmless():
    session = ClientSession(codec=make_codec("bin"), settings=SETTINGS, sdk="test")
    connection = session.open_connection(0.0)
    session.adopt(connection, 0.0)
    identity = session.submit("pnp", None, now=0.0, deadline_s=1.0)
    encode = session.codec.encode

    (move,) = session.receive(connection, encode(Move(reason="x", within_ms=math.nan)), 0.1)
    busy = Failure(id=identity, code="busy", message="", retry_after_ms=math.nan)
    session.receive(connection, encode(busy), 0.1)

    assert move == MoveRequested("x", 0.0)
    assert session.next_due(0.1) <= 1.0
    assert set(codes(session.due(1.0))) <= {identity}
    assert session.unanswered == 0


def test_a_payload_that_cannot_be_encoded_is_refused_before_it_becomes_a_command():
    session = make_session()
    open_connection(session)

    with pytest.raises(BadMessage):
        session.submit("pnp", {"x": object()}, now=0.0)
    with pytest.raises(LimitExceeded, match="4096"):
        session.submit("pnp", "x" * 5000, now=0.0)

    assert session.unanswered == 0


def test_abandoned_commands_end_with_the_reason():
    session = make_session()
    connection = open_connection(session)
    ids = [session.submit("pnp", None, now=0.0) for _ in range(3)]
    session.close_connection(connection)

    events = session.abandon("unauthorized", "the token is over", "get another")

    assert codes(events) == dict.fromkeys(ids, "unauthorized")
    assert {event.answer.hint for event in events} == {"get another"}
