"""A robot keeps to the rate that its server names, so it is never refused for it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire import Command, Limits, Ping, Result, make_codec
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionState
from rse_pf.wire.rate_limit import RateLimiter
from tests.kit.client_sessions import open_connection

CODEC = make_codec("json")
RATE = {"max_commands_per_s": 20.0, "command_burst": 40}


def welcomed(session: ClientSession, **limits: float) -> ConnectionState:
    connection = open_connection(session, **(limits or RATE))
    connection.outgoing.clear()
    return connection


def answer_all(session: ClientSession, connection: ConnectionState, now: float) -> tuple[list[object], int]:
    """Answer what was sent on *connection*; return the messages and how many commands came to their end."""
    messages = [CODEC.decode_from_robot(data) for data in connection.outgoing]
    connection.outgoing.clear()
    ended = 0
    for message in messages:
        if isinstance(message, Command):
            answer = CODEC.encode(Result(id=message.id, reply=None, server="a"))
            ended += sum(isinstance(event, Answered) for event in session.receive(connection, answer, now))
    return messages, ended


@given(
    bursts=st.lists(st.integers(0, 30), min_size=1, max_size=40),
    gap_s=st.floats(0.05, 3.0),
    delays_s=st.lists(st.floats(0.0, 0.1), min_size=1, max_size=10),
)
def test_a_server_never_receives_more_than_its_rate_limit(bursts, gap_s, delays_s):
    session = ClientSession(codec=CODEC, settings=SessionSettings(answer_timeout_s=1e4), sdk="t")
    connection, server, now, sent = welcomed(session), TokenBucket(20.0, 40.0), 0.0, 0
    for number, burst in enumerate(bursts):
        for _ in range(burst):
            session.submit("echo", {}, now=now, keep=True)
        until = now + gap_s
        while now < until:
            session.due(now)
            session.check(connection, now)
            messages, _ = answer_all(session, connection, now)
            for _ in messages:
                arrives = now + delays_s[(number + sent) % len(delays_s)]
                assert server.take(max(arrives, server.at)) == 0.0
                sent += 1
            now = min(until, max(now + 0.001, session.next_due(now)))


def test_waiting_commands_are_sent_as_soon_as_the_rate_allows():
    session = ClientSession(codec=CODEC, settings=SessionSettings(answer_timeout_s=100.0), sdk="t")
    connection, now, ended = welcomed(session), 0.0, 0
    for _ in range(90):
        session.submit("echo", {}, now=now, keep=True)
    while ended < 90:
        _, count = answer_all(session, connection, now)
        ended += count
        now = max(now + 0.001, session.next_due(now))
        session.due(now)
        assert now < 5.0, f"{ended} of 90"

    assert now >= 54 / 18 - 0.1


def test_pings_count_towards_the_rate():
    limiter = RateLimiter(Limits(max_message_bytes=4096, max_in_flight=8, **RATE))
    before = limiter.available(0.0)
    session = ClientSession(codec=CODEC, settings=SessionSettings(), sdk="t")
    connection = welcomed(session)

    session.check(connection, 0.5)

    assert isinstance(CODEC.decode_from_robot(connection.outgoing[-1]), Ping)
    assert connection.rate_limiter.available(0.5) == before - 1
