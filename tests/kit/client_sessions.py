"""A robot's side of the protocol without sockets: connections that are welcomed, and what they carried."""

from __future__ import annotations

from typing import Any

from rse_pf.config import SessionSettings
from rse_pf.wire import Command, Failure, Limits, Welcome, make_codec
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionState, Welcomed

SETTINGS = SessionSettings()
CODEC = make_codec("json", SETTINGS)


def make_session(settings: SessionSettings = SETTINGS) -> ClientSession:
    return ClientSession(codec=CODEC, settings=settings, sdk="test")


def tell(session: ClientSession, connection: ConnectionState, message: Any, now: float) -> list[Any]:
    """Let the session receive *message* on *connection*; return its events."""
    return session.receive(connection, session.codec.encode(message), now)


def open_connection(
    session: ClientSession, now: float = 0.0, server: str = "a", *, room: int = 8,
    token_s: float | None = None, **limits: Any,
) -> ConnectionState:  # fmt: skip
    """Open, welcome and adopt a connection."""
    connection = session.open_connection(now)
    welcome = Welcome(
        server=server, session="s", robot="r", protocol=1, clock_s=now, token_s=token_s,
        limits=Limits(max_message_bytes=4096, max_in_flight=room, **limits),
    )  # fmt: skip
    assert tell(session, connection, welcome, now) == [Welcomed(welcome)]
    session.adopt(connection, now)
    return connection


def sent(connection: ConnectionState) -> list[Any]:
    """Return and forget what the session wrote on *connection*."""
    messages = [CODEC.decode_from_robot(data) for data in connection.outgoing]
    connection.outgoing.clear()
    return messages


def commands(connection: ConnectionState) -> list[Command]:
    return [message for message in sent(connection) if isinstance(message, Command)]


def codes(events: list[Any]) -> dict[int, str]:
    """Return how each answered command ended."""
    return {
        event.id: event.answer.code if isinstance(event.answer, Failure) else "ok"
        for event in events
        if isinstance(event, Answered)
    }
