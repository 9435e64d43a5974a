"""Errors of failed attempts to connect: kind, pause before the next attempt, and the address as shown."""

from __future__ import annotations

import errno
import socket

import pytest

import client_sdk
from client_sdk.network.dial_errors import hide_password, http_status_error, no_answer_error, tcp_error
from client_sdk.transfer.data_client import DataClient
from rse_pf.auth.tokens import KeySet
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConnectError, Forbidden, Unauthorized, UsageError
from rse_pf.server.gateway.handshake import HandshakePolicy, Rejected, RequestHead
from rse_pf.wire.refusal import refusal_body

REFUSALS = [(401, "unauthorized", Unauthorized), (403, "forbidden", Forbidden)]


@pytest.mark.parametrize(("status", "code", "error"), REFUSALS)
def test_a_refusal_by_one_of_our_servers_concerns_the_robot(status, code, error):
    failed = http_status_error("ws://host/ws", status, {}, refusal_body(code, "no", "ask"))

    assert isinstance(failed.error, error)
    assert failed.is_refusal


@pytest.mark.parametrize("status", [401, 403])
@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"<html><center><h1>403 Forbidden</h1></center></html>",
        b'{"message":"Forbidden"}',
        b'{"code":"forbidden","message":"no","hint":""}',
        b'{"platform":"rse-pf","code":"full"}',
        b"[" * 4000,
        b'["rse-pf"]',
        b"\xff",
        refusal_body("forbidden", "x" * 5000, ""),
    ],
)
def test_a_refusal_of_whoever_stands_between_is_temporary(status, body):
    failed = http_status_error("ws://host/ws", status, {"Retry-After": "60"}, body)

    assert isinstance(failed.error, ConnectError)
    assert not failed.is_refusal
    assert not failed.is_wrong_address
    assert failed.retry_after_s == 60.0
    assert "firewall" in failed.error.hint


def test_every_refusal_of_the_handshake_carries_the_mark():
    policy = HandshakePolicy(PlatformSettings(), KeySet({}))

    refused = policy.decide(
        RequestHead(b"/ws", {b"authorization": b"Bearer x", b"sec-websocket-protocol": b"rse-pf.v1.json"}),
        is_full=False,
        anonymous="",
        now_s=0.0,
    )
    origin = policy.decide(
        RequestHead(b"/ws", {b"origin": b"https://elsewhere.example"}),
        is_full=False,
        anonymous="",
        now_s=0.0,
    )

    assert isinstance(refused, Rejected)
    assert isinstance(origin, Rejected)
    assert http_status_error("ws://host/ws", refused.status, {}, refused.body).is_refusal
    assert http_status_error("ws://host/ws", origin.status, {}, origin.body).is_refusal


@pytest.mark.parametrize(
    ("error", "is_unanswered"),
    [
        (OSError(errno.ENETUNREACH, "Network is unreachable"), True),
        (OSError(errno.EHOSTUNREACH, "No route to host"), True),
        (OSError(errno.ETIMEDOUT, "nobody answers"), True),
        (socket.gaierror(-2, "Name or service not known"), True),
        (ConnectionRefusedError(errno.ECONNREFUSED, "refused"), False),
    ],
)
def test_what_reaches_nobody_is_distinguished_from_what_a_firewall_counts(error, is_unanswered):
    assert tcp_error("ws://host/ws", error).is_unanswered is is_unanswered


def test_a_slow_server_of_ours_is_not_taken_for_another_program():
    failed = no_answer_error("wss://host/ws", TimeoutError(), within_s=5.0)

    assert failed.error.message == "wss://host/ws sends no answer within 5 s"
    assert not failed.is_wrong_address


def test_the_cause_and_the_time_of_a_refusal_reach_the_robot():
    body = refusal_body(
        "unauthorized", "tokens issued before noon are revoked", "sign another one",
        cause="cut-off", valid_from_s=1700000000.0,
    )  # fmt: skip

    failed = http_status_error("ws://host/ws", 401, {}, body)

    assert (failed.error.message, failed.error.hint) == (
        "tokens issued before noon are revoked", "sign another one"
    )  # fmt: skip
    assert failed.valid_from_s == 1700000000.0
    assert failed.refuses_any_token


@pytest.mark.parametrize("time", [True, "1700000000", -1, 1e12, float("nan"), None])
def test_a_time_that_is_none_is_not_trusted(time):
    body = refusal_body("unauthorized", "no", "", cause="cut-off", valid_from_s=time)

    assert http_status_error("ws://host/ws", 401, {}, body).valid_from_s is None


def test_a_cause_with_line_breaks_is_not_shown():
    body = refusal_body("unauthorized", "no\x1b[2J\nroot:", "", cause="disabled")

    assert http_status_error("ws://host/ws", 401, {}, body).error.message == ""


@pytest.mark.parametrize(
    ("status", "is_wrong_address", "hint"),
    [(400, True, "URL"), (404, True, "URL"), (429, False, "later"), (503, False, "later")],
)
def test_other_statuses_allow_another_attempt_and_hint_at_the_cause(status, is_wrong_address, hint):
    failed = http_status_error("ws://host/ws", status, {})

    assert isinstance(failed.error, ConnectError)
    assert not failed.is_refusal
    assert failed.is_wrong_address is is_wrong_address
    assert hint in failed.error.hint


@pytest.mark.parametrize(("header", "after_s"), [("", 0.0), ("5", 5.0), ("86400", 300.0), ("soon", 0.0)])
def test_the_wait_that_a_server_asks_for_is_bounded(header, after_s):
    assert http_status_error("ws://host/ws", 503, {"retry-after": header}).retry_after_s == after_s


@pytest.mark.parametrize("url", ["wws://robot:secret@host/ws", "ws://r:secret@:80/ws", "host?t=secret"])
@pytest.mark.parametrize("use", [client_sdk.connect, lambda url: DataClient(url, "t"), hide_password])
def test_a_refused_address_is_shown_without_credentials(use, url):
    with pytest.raises(UsageError) as raised:
        use(url)
    assert "secret" not in str(raised.value)
    assert "is not a" in raised.value.message


def test_the_address_of_a_redirect_is_shown_without_credentials():
    headers = {"Location": "https://robot:secret@host/a?token=secret"}
    error = http_status_error("ws://host/ws", 301, headers).error
    assert "secret" not in error.message + error.hint
    assert "https://host/a" in error.hint
