"""What the gateway relies on in picows beyond its documentation; the version is pinned, too."""

from __future__ import annotations

import errno
from types import SimpleNamespace

from picows import picows

from rse_pf.server.gateway.websocket import Listener, RobotProtocol
from rse_pf.server.scheduling.socket_poller import SocketPoller
from tests.kit.fakes import FakeLoop


async def test_the_protocol_takes_the_options_that_we_give_it():
    poller = SocketPoller(FakeLoop(), clock=lambda: 0.0)
    protocol = RobotProtocol(
        picows.WSListener(), "", b"", b"", max_frame_bytes=1000, poller=poller, on_end=lambda: None
    )

    assert isinstance(protocol, picows.WSProtocol)
    assert protocol.transport is None
    assert len(protocol.get_buffer(-1)) >= 1024


def test_opcodes_are_the_numbers_of_the_rfc():
    names = ("CONTINUATION", "TEXT", "BINARY", "CLOSE", "PING", "PONG")

    assert [int(getattr(picows.WSMsgType, name)) for name in names] == [0, 1, 2, 8, 9, 10]


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
