"""Let an observer see every message of a robot's connections, such as a recorder."""

from __future__ import annotations

from typing import Literal, Protocol

from rse_pf.wire import Codec

__all__ = ["MessageTap"]


class MessageTap(Protocol):
    """Observe the messages of all connections of one robot.

    The ``return`` in each body lets programs inherit the methods that they do not need.
    `client_sdk.network.connection` calls the methods in its event loop, so they must return at once.
    """

    def open_connection(self, codec: Codec, token: str | None) -> int:
        """Return a number that identifies a new connection in later calls.

        Args:
            codec: Decodes the messages of the connection.
            token: Text of the token by which the robot authenticated itself, None without one.  It is a
                secret, and is part of some messages.
        """
        return 0

    def observe_message(self, connection: int, direction: Literal["up", "down"], data: bytes) -> None:
        """Observe the bytes of one message: ``up`` from robot to server, ``down`` from server to robot.

        *data* is the message as the WebSocket carries it; the first ones are the hello and the welcome.
        """
        return

    def close_connection(self, connection: int) -> None:
        """Observe that *connection* has ended."""
        return
