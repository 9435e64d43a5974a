"""Let a `ServerSession` take whole messages and answer commands, as its server does."""

from __future__ import annotations

from rse_pf.errors import ProtocolError
from rse_pf.wire import Failure, Result
from rse_pf.wire.messages import FromRobot
from rse_pf.wire.server_session import Decision, Send, ServerSession

__all__ = ["answer", "receive"]

_SHORT_BYTES = 16_384


def receive(session: ServerSession, data: bytes, now: float) -> list[Decision]:
    """Return the decisions about one message: a short one is decoded at once, a long one beforehand."""
    decisions = session.receive_short(data, now, _SHORT_BYTES)
    if decisions is not None:
        return decisions
    try:
        message: FromRobot | ProtocolError = session.codec.decode_from_robot(data)
    except ProtocolError as error:
        message = error
    return session.take(message, now, data)


def answer(session: ServerSession, message: Result | Failure) -> Send:
    """Return the message with the final answer to a command that was submitted."""
    session.in_flight -= 1
    return Send(session.codec.encode(message))
