"""The listening socket of a server."""

from __future__ import annotations

import socket

import pytest

from rse_pf.backend.supervisor.listener import bound_socket, check_authentication
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError

OPEN = {"auth": {"required": False}}


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_a_server_on_loopback_needs_no_authentication(host: str) -> None:
    check_authentication(PlatformSettings.from_dict({**OPEN, "serving": {"host": host}}), None, False)


def test_a_server_that_other_machines_reach_needs_authentication() -> None:
    settings = PlatformSettings.from_dict({**OPEN, "serving": {"host": "0.0.0.0"}})

    with pytest.raises(ConfigurationError, match=r"auth\.required") as told:
        check_authentication(settings, None, False)

    assert "127.0.0.1" in told.value.hint


def test_a_socket_is_bound_but_refuses_connections_until_it_listens() -> None:
    with bound_socket("127.0.0.1", 0) as listener:
        address = listener.getsockname()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address)
        listener.listen()
        with pytest.raises(ConfigurationError, match="cannot listen on"):
            bound_socket(*address)
