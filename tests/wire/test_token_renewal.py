"""A fresh token on a live socket: asked for in time, verified by the server, never a reason to end."""

from __future__ import annotations

import itertools

import pytest

from rse_pf.wire import Failure, Hello, Renew, Renewed, Welcome
from rse_pf.wire.client_session import ClientSession, ConnectionState, RenewalDue
from rse_pf.wire.renewal_timer import RenewalTimer
from rse_pf.wire.server_session import RENEWAL_PAUSE_S, Renewal, Send, ServerSession
from tests.kit import server_sessions
from tests.kit.client_sessions import CODEC, SETTINGS, make_session, open_connection


def server_session(token_s: float | None = 100.0) -> tuple[ServerSession, Welcome]:
    session = ServerSession(codec=CODEC, robot="r", server="s", session="x", limits=SETTINGS)
    session.ends_s = token_s  # the session hears Hello at 0
    (send,) = server_sessions.receive(session, CODEC.encode(Hello()), 0.0)
    assert isinstance(send, Send)
    welcome = CODEC.decode_from_server(send.data)
    assert isinstance(welcome, Welcome)
    return session, welcome


def linked(token_s: float | None) -> tuple[ClientSession, ConnectionState]:
    session = make_session()
    return session, open_connection(session, token_s=token_s)


def asked_at(session: ClientSession, connection: ConnectionState, until: int) -> list[int]:
    """Return in which seconds the session asked for a fresh token, with a server that answers pings."""
    asked = []
    for now in range(1, until):
        connection.ping_sent, connection.last_received = None, float(now)
        if RenewalDue() in session.check(connection, float(now)):
            asked.append(now)
    return asked


def test_the_welcome_says_how_long_the_token_is_good():
    assert server_session(100.0)[1].token_s == 100.0
    assert server_session(None)[1].token_s is None


def test_a_fresh_token_is_returned_for_verification_and_the_result_is_sent():
    session, _ = server_session()

    assert server_sessions.receive(session, CODEC.encode(Renew(token="t")), 5.0) == [Renewal("t")]
    told = session.answer_renewal(900.0)
    refused = session.answer_renewal(None)

    assert isinstance(told, Send)
    assert isinstance(refused, Send)
    assert CODEC.decode_from_server(told.data) == Renewed(token_s=900.0)
    failure = CODEC.decode_from_server(refused.data)
    assert isinstance(failure, Failure)
    assert (failure.id, failure.code) == (None, "unauthorized")


def test_renewals_in_quick_succession_are_not_verified():
    session, _ = server_session()
    renew = CODEC.encode(Renew(token="t"))
    server_sessions.receive(session, renew, 5.0)

    (send,) = server_sessions.receive(session, renew, 5.0 + RENEWAL_PAUSE_S / 2)

    assert isinstance(send, Send)
    failure = CODEC.decode_from_server(send.data)
    assert isinstance(failure, Failure)
    assert failure.code == "busy"
    assert server_sessions.receive(session, renew, 5.0 + RENEWAL_PAUSE_S) == [Renewal("t")]


def test_a_renewal_is_due_after_four_fifths_of_the_ttl_and_then_more_often():
    asked = asked_at(*linked(100.0), 100)

    assert asked[:3] == [80, 90, 95]
    assert asked == sorted(set(asked))
    assert min(b - a for a, b in itertools.pairwise(asked)) >= RENEWAL_PAUSE_S


def test_after_a_renewal_the_next_one_is_due_in_the_new_ttl():
    session, connection = linked(100.0)
    session.receive(connection, CODEC.encode(Renewed(token_s=1000.0)), 80.0)

    assert asked_at(session, connection, 1080)[:2] == [880, 980]


def test_a_connection_that_is_being_left_is_not_renewed():
    session, connection = linked(100.0)
    connection.leaving = True

    assert asked_at(session, connection, 100) == []


@pytest.mark.parametrize("absurd", [-1.0, 1e12])
def test_an_implausible_expiry_counts_as_one_hour(absurd: float):
    timer = RenewalTimer()
    timer.expires_in(absurd, 0.0)

    assert timer.ends_s == 3600.0
