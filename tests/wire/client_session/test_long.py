"""Long commands on the robot's side: progress, no deadline but the caller's, taken back, asked again."""

from __future__ import annotations

from rse_pf.wire import Cancel, Command, Failure, Progress, Result
from rse_pf.wire.client_session import Progressed
from tests.kit.client_sessions import SETTINGS, codes, commands, make_session, open_connection, sent, tell


def result(command: Command) -> Result:
    return Result(id=command.id, reply=command.seq, server="a")


def test_a_command_that_reports_progress_has_no_deadline_but_its_callers():
    session = make_session()
    connection = open_connection(session)
    session.submit("merge", None, now=0.0)
    (command,) = commands(connection)

    (progressed,) = tell(session, connection, Progress(id=command.id, done=0.25, what="pairs"), 1.0)

    assert progressed == Progressed(command.id, 0.25, "pairs")
    assert session.due(4000.0) == []
    assert codes(tell(session, connection, result(command), 5000.0)) == {command.id: "ok"}


def test_a_long_command_ends_at_the_deadline_of_its_caller_and_is_cancelled():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("merge", None, now=0.0, deadline_s=10.0)
    tell(session, connection, Progress(id=identity, done=0.0), 1.0)
    sent(connection)

    assert codes(session.due(10.0)) == {identity: "expired"}
    assert sent(connection) == [Cancel(id=identity)]


def test_a_long_command_is_sent_again_after_a_cut_and_on_a_move_without_waiting_for_the_old_server():
    session = make_session()
    first = open_connection(session)
    identity = session.submit("merge", None, now=0.0, is_open_ended=True)
    tell(session, first, Progress(id=identity, done=0.0), 1.0)

    second = open_connection(session, now=50.0, server="b")
    assert [command.id for command in commands(second)] == [identity]
    assert session.unanswered_on(first) == 0
    session.close_connection(second)
    third = open_connection(session, now=99.0, server="c")

    assert [command.id for command in commands(third)] == [identity]


def test_a_cancelled_command_is_cancelled_on_the_server_when_it_turns_out_to_be_long():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("merge", None, now=0.0)
    session.cancel(identity)
    assert Cancel(id=identity) not in sent(connection)

    assert tell(session, connection, Progress(id=identity, done=0.0), 0.1) == []
    tell(session, connection, Progress(id=identity, done=0.1), 0.6)

    assert sent(connection).count(Cancel(id=identity)) == 1


def test_waiting_for_a_long_command_is_no_stall():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("merge", None, now=0.0)
    tell(session, connection, Progress(id=identity, done=0.0), 0.1)
    session.check(connection, 0.1)
    sent(connection)

    assert session.check(connection, 0.1 + SETTINGS.ping_interval_s / 2) == []
    assert sent(connection) == []


def test_a_long_command_is_cancelled_once_when_its_caller_gives_up():
    session = make_session()
    connection = open_connection(session)
    identity = session.submit("merge", None, now=0.0)
    tell(session, connection, Progress(id=identity, done=0.0), 0.1)
    sent(connection)

    session.cancel(identity)
    session.cancel(identity)

    assert sent(connection) == [Cancel(id=identity)]
    cancelled = Failure(id=identity, code="cancelled", message="taken back")
    assert tell(session, connection, cancelled, 0.2) == []
    assert session.unanswered == 0


def test_a_long_command_cancelled_without_a_connection_is_cancelled_on_the_next():
    session = make_session()
    first = open_connection(session)
    identity = session.submit("merge", None, now=0.0, is_open_ended=True)
    tell(session, first, Progress(id=identity, done=0.1), 1.0)
    session.close_connection(first)
    session.cancel(identity)
    session.due(1e6)

    second = open_connection(session, now=1e6, server="b")

    asked = [message for message in sent(second) if isinstance(message, Command | Cancel)]
    assert [type(message) for message in asked] == [Command, Cancel]
    assert {message.id for message in asked} == {identity}
    taken_back = Failure(id=identity, code="cancelled", message="taken back")
    assert tell(session, second, taken_back, 1e6 + 1) == []
    session.close_connection(second)
    assert commands(open_connection(session, now=1e6 + 9, server="c")) == []


def test_a_cancel_that_was_lost_with_its_connection_is_sent_again():
    session = make_session()
    first = open_connection(session)
    identity = session.submit("merge", None, now=0.0, deadline_s=10.0)
    tell(session, first, Progress(id=identity, done=0.1), 1.0)
    assert codes(session.due(10.0)) == {identity: "expired"}
    assert session.unanswered == 0
    session.close_connection(first)

    second = open_connection(session, now=20.0, server="b")

    assert [message.id for message in sent(second) if isinstance(message, Cancel)] == [identity]
    assert session.due(3600.0) == []


def test_a_short_command_whose_caller_gave_up_is_not_sent_again():
    session = make_session()
    first = open_connection(session)
    identity = session.submit("pnp", None, now=0.0)
    session.close_connection(first)
    session.cancel(identity)

    assert commands(open_connection(session, now=1.0, server="b")) == []
