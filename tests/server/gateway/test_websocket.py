"""What the gateway relies on in picows beyond its documentation; the version is pinned, too."""

from __future__ import annotations

import errno
from types import SimpleNamespace

from rse_pf.server.gateway.websocket import Listener
from tests.kit.fakes import FakeLoop


def test_a_socket_that_the_robot_has_reset_can_be_closed():
    done: list[str] = []

    class Transport:
        """A socket whose reset the event loop has not seen yet."""

        @property
        def underlying_transport(self) -> Transport:
            return self

        def set_write_buffer_limits(self, high: int, low: int) -> None:
            pass

        def send_close(self, code: int, reason: bytes) -> None:
            done.append(f"{code} {reason.decode()}")

        def write_eof(self) -> None:
            raise OSError(errno.ENOTCONN, "Transport endpoint is not connected")

        def disconnect(self, graceful: bool) -> None:
            done.append("disconnected")

    loop = FakeLoop(0.0)
    dispatcher = SimpleNamespace(connect=lambda *arguments: None, context=SimpleNamespace(loop=loop))
    listener = Listener(dispatcher, SimpleNamespace(claims=None), 1)
    listener.on_ws_connected(Transport())

    listener.close(4403, "revoked")
    loop.advance(60.0)

    assert done == ["4403 revoked", "disconnected"], "one robot's socket must not end its worker"
