"""Let an observer see every message of a robot's connections, such as a recorder; the default sees
nothing."""

from __future__ import annotations

from typing import Literal, Protocol

from rse_pf.wire import Codec

__all__ = ["MessageTap", "NullMessageTap"]


class MessageTap(Protocol):
    """Observe the messages of all connections of one robot.

    `client_sdk.network.connection` calls the methods in its event loop, so they must return at once and
    raise nothing.
    """

    def open_connection(self, codec: Codec, token: str | None) -> int:
        """Return a number that identifies a new connection in later calls.

        Args:
            codec: Decodes the messages of the connection.
            token: Text of the token by which the robot authenticated itself, None without one.
        """
        ...

    def observe_message(self, connection: int, direction: Literal["up", "down"], data: bytes) -> None:
        """Observe the bytes of one message: ``up`` from robot to server, ``down`` from server to robot."""
        ...

    def close_connection(self, connection: int) -> None:
        """Observe that *connection* has ended."""
        ...


class NullMessageTap:
    """Ignore all messages: the tap of a robot that nobody observes."""

    def open_connection(self, codec: Codec, token: str | None) -> int:
        """Return 0 for every connection."""
        return 0

    def observe_message(self, connection: int, direction: Literal["up", "down"], data: bytes) -> None:
        """Ignore the bytes of a message."""

    def close_connection(self, connection: int) -> None:
        """Ignore the end of the connection."""
