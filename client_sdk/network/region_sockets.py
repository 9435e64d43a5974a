"""Hold the state of each address of a robot (a region) and of each WebSocket that is open there.

`client_sdk.network.connection` reads and changes this state; its module text lists the states and the
transitions between them.
"""

from __future__ import annotations

import asyncio

from websockets.asyncio.client import ClientConnection

from client_sdk.network.backoff import Backoff
from client_sdk.network.dial_errors import DialError, hide_password
from rse_pf.wire.client_session import ConnectionState
from rse_pf.wire.clock_offset import Exchange

__all__ = ["Region", "RegionSocket"]


class Region:
    """Hold one address of a robot and the socket that is kept open to it."""

    def __init__(self, number: int, url: str, backoff: Backoff) -> None:
        """Describe an address to which no socket is open yet.

        Args:
            number: Position of the region in the robot's list of addresses, from 0.
            url: WebSocket address, perhaps with user name and password.
            backoff: Decides the pauses between attempts to connect to this address.
        """
        self.number = number
        self.url = url
        self.shown_url = hide_password(url) if url else ""
        self.backoff = backoff
        self.socket: RegionSocket | None = None
        self.connected_since_s = 0.0
        """When `socket` received its Welcome, seconds of the robot's monotonic clock."""
        self.first_join: asyncio.Task[DialError | None] | None = None
        """The attempt of the robot's first connect that was still running when another region was chosen."""
        self.move_request: tuple[RegionSocket, float] | None = None
        """The socket whose server asks the robot to move, and when attempts to reach another server end.

        The time is in seconds of the robot's monotonic clock.  None: no server asks for a move.
        """
        self.is_duplicate = False
        """Whether another address of the robot leads to the same platform, which keeps one connection
        only."""
        self.last_failure: DialError | None = None
        """Why the last attempt failed or the server closed the socket; None if neither has a known cause."""
        self.has_changed = asyncio.Event()
        """Set when the task that maintains this region has to look at its state again."""

    @property
    def usable_socket(self) -> RegionSocket | None:
        """The socket of this region if it may carry new commands: it is not leaving, closing or ended."""
        socket = self.socket
        is_unusable = socket is None or socket.state.leaving or socket.is_closing or socket.has_ended.is_set()
        return None if is_unusable else socket


class RegionSocket:
    """Hold one WebSocket, its protocol state, and the two tasks that read and write it."""

    def __init__(self, region: Region, websocket: ClientConnection, state: ConnectionState) -> None:
        """Begin in the state OPENING: the handshake is over, and no Welcome has arrived."""
        self.region = region
        self.websocket = websocket
        self.state = state
        self.welcomed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done at the Welcome; holds a DialError if the socket ended or was refused before."""
        self.has_outgoing = asyncio.Event()
        """Set when `state` may hold messages that the writing task has to send."""
        self.is_closing = False
        """Whether the WebSocket's close handshake was begun by this robot."""
        self.has_ended = asyncio.Event()
        self.has_round_trip = asyncio.Event()
        """Set after the first measured ping, or when the socket has ended."""
        self.measured_exchange: Exchange | None = None
        """The last ping and pong that were counted as a round trip of the region."""
        self.tasks: list[asyncio.Task[None]] = []
        self.malformed_messages = 0
        self.tap_number = 0
        """The number by which the message tap knows this connection."""
