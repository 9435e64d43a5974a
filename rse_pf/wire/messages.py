"""The messages of protocol version 1, as types.

``docs/protocol.md`` describes the same in words; the golden messages check both.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

__all__ = [
    "PROTOCOL_VERSION",
    "Cancel",
    "Command",
    "Failure",
    "FromRobot",
    "FromServer",
    "Hello",
    "Limits",
    "Message",
    "Move",
    "Ping",
    "Pong",
    "Progress",
    "Renew",
    "Renewed",
    "Result",
    "Subscribe",
    "Unsubscribe",
    "Update",
    "Welcome",
]

PROTOCOL_VERSION = 1

Word = Annotated[str, msgspec.Meta(max_length=64)]
"""A name of at most 64 characters."""

Topic = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
"""What updates are about, such as ``live/MAP``."""

Identifier = Annotated[int, msgspec.Meta(ge=0, le=2**53 - 1)]
"""A counter that every language's number type can hold."""

Milliseconds = Annotated[float, msgspec.Meta(ge=0, le=3.6e6)]


class _Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", omit_defaults=True):
    """Unknown fields are ignored, so that a newer side may say more."""


class Limits(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the server accepts from this robot; a rate of 0 is none.

    ``burst_commands_per_day`` bounds what it may send to `Welcome.burst_url`.
    """

    max_message_bytes: int
    max_in_flight: int
    max_commands_per_s: float = 0.0
    command_burst: int = 0
    burst_commands_per_day: int = 0


class Hello(_Message, frozen=True, kw_only=True, tag="hello"):
    """Robot, first message of a socket."""

    protocol: int = PROTOCOL_VERSION
    sdk: Word = ""
    capabilities: Annotated[tuple[Word, ...], msgspec.Meta(max_length=32)] = ()


class Welcome(_Message, frozen=True, kw_only=True, tag="welcome"):
    """Server, answer to Hello: who serves, and what it accepts.

    ``token_s``: the socket ends in so many seconds, unless a fresh token comes first.  ``burst_url``: where
    commands are answered by HTTP while the servers cannot, an address or a path at the robot's own address.
    ``tenant`` and ``scopes`` are what the server takes the robot's token for; no scopes allow everything.
    """

    server: str
    session: str
    robot: str
    protocol: int
    limits: Limits
    clock_s: float
    token_s: float | None = None
    burst_url: str = ""
    tenant: str | None = None
    scopes: tuple[str, ...] = ()


class Command(_Message, frozen=True, kw_only=True, tag="command"):
    """Robot asks a service.  ``payload`` takes its type when its service is known.

    ``deadline_ms`` counts from arrival.  Within ``stream`` the newest ``seq`` wins, unless ``keep``.
    """

    id: Identifier
    service: Word
    payload: Any = None
    stream: Word = ""
    seq: Identifier = 0
    keep: bool = False
    deadline_ms: Milliseconds | None = None
    trace: Word = ""


class Cancel(_Message, frozen=True, kw_only=True, tag="cancel"):
    """Robot takes back a command that reported progress; its answer may still come first."""

    id: Identifier


class Progress(_Message, frozen=True, kw_only=True, tag="progress"):
    """Server tells how far a long command is: the share *done* (0..1), and *what* was done last.

    Only to robots whose Hello names the capability ``progress``; the first one says that it was taken.
    """

    id: int
    done: float
    what: str = ""


class Result(_Message, frozen=True, kw_only=True, tag="result"):
    """Server answers a command.  ``received_s`` and ``sent_s`` are readings of the server's clock.

    ``object`` is the sha256 of a reply that is kept as an object; where it is too large for a message,
    ``reply`` is left out.
    """

    id: int
    reply: Any = None
    server: str = ""
    queue_ms: float = 0.0
    compute_ms: float = 0.0
    received_s: float = 0.0
    sent_s: float = 0.0
    object: str = ""


class Failure(_Message, frozen=True, kw_only=True, tag="failure"):
    """Server says why a command, or (without ``id``) a message or the session, failed."""

    id: int | None = None
    code: str
    message: str
    hint: str = ""
    retry_after_ms: float | None = None
    server: str = ""
    trace: str = ""


class Move(_Message, frozen=True, kw_only=True, tag="move"):
    """Server asks the robot to open another socket first and then to leave this one."""

    reason: str
    within_ms: float


class Ping(_Message, frozen=True, kw_only=True, tag="ping"):
    """Robot reads its clock.  ``sent_s`` is the first of four stamps."""

    sent_s: float


class Pong(_Message, frozen=True, kw_only=True, tag="pong"):
    """Server returns the robot's stamp and adds its own two; the robot reads the fourth."""

    sent_s: float
    received_s: float
    answered_s: float


class Renew(_Message, frozen=True, kw_only=True, tag="renew"):
    """Robot shows a fresh token of its own, so that the socket outlives the one it was opened with."""

    token: Annotated[str, msgspec.Meta(max_length=65536)]


class Renewed(_Message, frozen=True, kw_only=True, tag="renewed"):
    """Server took the fresh token: the socket ends in ``token_s`` seconds, counted from this answer."""

    token_s: float


class Subscribe(_Message, frozen=True, kw_only=True, tag="subscribe"):
    """Robot wants the updates of a topic, from its present state on.

    Only from robots whose Hello names the capability ``updates``.  A refusal is a Failure with this ``id``,
    which no command of the robot has.
    """

    id: Identifier
    topic: Topic


class Unsubscribe(_Message, frozen=True, kw_only=True, tag="unsubscribe"):
    """Robot wants no more updates of this subscription; one that is on its way may still come."""

    id: Identifier


class Update(_Message, frozen=True, kw_only=True, tag="update"):
    """Server tells the newest value of one *key* of a topic; older values of the key are void.

    ``seq`` counts all values of the subscription from 1, so that a gap says how many were replaced by newer
    ones before they could be sent.
    """

    id: int
    topic: str
    seq: int
    key: str = ""
    payload: Any = None


FromRobot = Hello | Command | Ping | Cancel | Renew | Subscribe | Unsubscribe
FromServer = Welcome | Result | Failure | Move | Pong | Progress | Renewed | Update
Message = FromRobot | FromServer
