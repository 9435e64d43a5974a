"""The listening socket of a server."""

from __future__ import annotations

import asyncio
import socket

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.server.supervisor.listener import bound_socket, check_authentication, open_control

OPEN = {"auth": {"required": False}}


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_a_server_on_loopback_needs_no_authentication(host: str) -> None:
    check_authentication(PlatformSettings.from_dict({**OPEN, "serving": {"host": host}}), None, False)


def test_the_hint_of_a_taken_port_names_the_setting_that_chooses_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        serving = PlatformSettings.from_dict({"serving": {"control_port": port}}).serving
        with pytest.raises(ConfigurationError, match=f":{port}: ") as robots:
            bound_socket("127.0.0.1", port)
        with pytest.raises(ConfigurationError, match=f":{port}: ") as control:
            asyncio.run(open_control(serving, lambda request: pytest.fail("it answered")))

    assert robots.value.hint == "choose another serving.port, or 0"
    assert control.value.hint == "choose another serving.control_port, or 0"
