"""What a failed connection attempt means for the next one, and how an address is shown."""

from __future__ import annotations

import pytest

from client_sdk.connection import dial_error_of, shown_address
from rse_pf.errors import ConnectError, Forbidden, Unauthorized, UsageError


@pytest.mark.parametrize(("status", "error"), [(401, Unauthorized), (403, Forbidden)])
def test_a_refused_token_or_robot_is_final(status, error):
    failed = dial_error_of("ws://host/ws", status, "")

    assert isinstance(failed.error, error)
    assert failed.is_final


@pytest.mark.parametrize(
    ("status", "is_wrong_address", "hint"),
    [(400, True, "URL"), (404, True, "URL"), (429, False, "later"), (503, False, "later")],
)
def test_other_statuses_allow_another_attempt_and_hint_at_the_cause(status, is_wrong_address, hint):
    failed = dial_error_of("ws://host/ws", status, "")

    assert isinstance(failed.error, ConnectError)
    assert not failed.is_final
    assert failed.is_wrong_address is is_wrong_address
    assert hint in failed.error.hint


@pytest.mark.parametrize(("header", "after_s"), [("", 0.0), ("5", 5.0), ("86400", 30.0), ("soon", 0.0)])
def test_the_wait_that_a_server_asks_for_is_bounded(header, after_s):
    assert dial_error_of("ws://host/ws", 503, header).after_s == after_s


def test_a_shown_address_holds_no_credentials():
    assert shown_address("wss://robot:secret@host:443/ws?token=x") == "wss://host:443/ws"


@pytest.mark.parametrize("url", ["http://host/ws", "ws:///ws", "ws://host:99999/ws", "host"])
def test_an_address_that_is_no_websocket_address_is_refused(url):
    with pytest.raises(UsageError, match="not a WebSocket address"):
        shown_address(url)
