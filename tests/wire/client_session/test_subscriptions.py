"""A robot's subscriptions across its connections, without input or output."""

from __future__ import annotations

from typing import Any

from rse_pf.config import SessionSettings
from rse_pf.wire import CODECS, Failure, Limits, Message, Subscribe, Unsubscribe, Update, Welcome, make_codec
from rse_pf.wire.client_session import ClientSession, ConnectionState
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated

WELCOME = Welcome(
    server="s", session="x", robot="r", protocol=1, clock_s=0.0,
    limits=Limits(max_message_bytes=262144, max_in_flight=8, max_commands_per_s=20.0, command_burst=40),
)  # fmt: skip


class SubscribedSession:
    """A session, and the connections that a test gives it."""

    def __init__(self, codec: str = "json") -> None:
        self.session = ClientSession(codec=make_codec(codec), settings=SessionSettings(), sdk="test")

    def connect(self, now: float = 0.0) -> ConnectionState:
        connection = self.session.open_connection(now)
        connection.outgoing.clear()
        self.hear(connection, WELCOME, now)
        self.session.adopt(connection, now)
        return connection

    def hear(self, connection: ConnectionState, message: Message, now: float = 0.0) -> list[Any]:
        return self.session.receive(connection, self.session.codec.encode(message), now)

    def said(self, connection: ConnectionState) -> list[Any]:
        said = [self.session.codec.decode_from_robot(data) for data in connection.outgoing]
        connection.outgoing.clear()
        return said


def update(identity: int, seq: int, key: str = "map", value: Any = None) -> Update:
    return Update(id=identity, topic="live/m", seq=seq, key=key, payload=value)


def test_a_subscription_is_asked_for_at_once_and_its_updates_are_events() -> None:
    for codec in CODECS:
        robot = SubscribedSession(codec)
        connection = robot.connect()

        identity = robot.session.subscribe("live/m", 0.0)

        assert robot.said(connection) == [Subscribe(id=identity, topic="live/m")]
        assert robot.hear(connection, update(identity, 1, value={"a": 1})) == [
            Updated(identity, "map", {"a": 1})
        ]


def test_no_command_has_the_id_of_a_subscription() -> None:
    robot = SubscribedSession()
    identity = robot.session.subscribe("live/m", 0.0)

    assert robot.session.submit("echo", {"value": 1}, now=0.0) == identity + 1
    assert robot.session.subscribe("live/n", 0.0) == identity + 2


def test_a_subscription_begins_again_on_the_next_connection() -> None:
    robot = SubscribedSession()
    first = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    robot.said(first)
    robot.hear(first, update(identity, 5))
    robot.session.close_connection(first)

    second = robot.connect(10.0)

    assert robot.said(second) == [Subscribe(id=identity, topic="live/m")]
    assert robot.hear(second, update(identity, 1)) == [Updated(identity, "map", None)]


def test_one_that_was_made_while_the_connection_was_lost_begins_on_the_next() -> None:
    robot = SubscribedSession()

    identity = robot.session.subscribe("live/m", 0.0)

    assert robot.said(robot.connect(1.0)) == [Subscribe(id=identity, topic="live/m")]


def test_after_a_move_only_the_new_connection_counts() -> None:
    robot = SubscribedSession()
    old = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    new = robot.connect(1.0)

    assert robot.hear(old, update(identity, 7)) == []
    assert robot.hear(new, update(identity, 1)) != []
    robot.session.close_connection(old)
    assert robot.hear(new, update(identity, 2)) != []
    assert robot.said(new) == [Subscribe(id=identity, topic="live/m")]


def test_an_ended_subscription_is_said_and_later_updates_of_it_are_ignored() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    robot.said(connection)

    robot.session.unsubscribe(identity, 0.0)
    robot.session.unsubscribe(identity, 0.0)

    assert robot.said(connection) == [Unsubscribe(id=identity)]
    assert robot.hear(connection, update(identity, 1)) == []
    assert robot.said(robot.connect(1.0)) == []


def test_a_refused_subscription_ends_and_is_not_asked_for_again() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    failure = Failure(id=identity, code="forbidden", message="no")

    assert robot.hear(connection, failure) == [SubscriptionEnded(identity, failure)]
    assert robot.said(robot.connect(1.0)) == []
    assert robot.session.dropped_answers == 0


def test_a_server_that_does_not_answer_is_asked_again_a_few_times() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    robot.said(connection)
    ended: list[Any] = []
    asked: list[Any] = []

    for now in range(1, 60):
        ended += robot.session.due(float(now))
        asked += robot.said(connection)

    assert asked == [Subscribe(id=identity, topic="live/m")] * 2
    assert [(each.id, each.failure.code) for each in ended] == [(identity, "unsupported")]


def test_one_that_was_answered_is_not_asked_for_again() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)
    robot.hear(connection, update(identity, 1))
    robot.said(connection)

    assert robot.session.due(100.0) == []
    assert robot.said(connection) == []


def test_gaps_in_the_numbers_are_the_values_that_were_replaced() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)

    for seq in (1, 2, 7, 8):
        robot.hear(connection, update(identity, seq))

    assert robot.session.subscriptions.replaced == 4


def test_an_update_of_another_topic_or_of_no_subscription_is_ignored() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    identity = robot.session.subscribe("live/m", 0.0)

    assert robot.hear(connection, Update(id=identity, topic="live/other", seq=1)) == []
    assert robot.hear(connection, update(identity + 1, 1)) == []


def test_subscriptions_count_towards_the_rate_of_the_robot() -> None:
    robot = SubscribedSession()
    connection = robot.connect()
    before = connection.rate_limiter.available(0.0)

    robot.session.subscribe("live/m", 0.0)

    assert connection.rate_limiter.available(0.0) == before - 1


def test_a_robot_that_gives_up_ends_its_subscriptions() -> None:
    robot = SubscribedSession()
    identity = robot.session.subscribe("live/m", 0.0)

    [ended] = robot.session.abandon("unauthorized", "the token is wrong", "issue one")

    assert isinstance(ended, SubscriptionEnded)
    assert (ended.id, ended.failure.code, ended.failure.hint) == (identity, "unauthorized", "issue one")
