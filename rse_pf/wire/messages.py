"""The messages of protocol version 1, as types.

``docs/protocol.md`` describes the same messages; the golden messages check both.
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

# Version of the protocol that a Hello and a Welcome state.
PROTOCOL_VERSION = 1

Word = Annotated[str, msgspec.Meta(max_length=64)]
"""A name of at most 64 characters."""

Topic = Annotated[str, msgspec.Meta(min_length=1, max_length=128)]
"""The topic of a subscription, such as ``live/MAP``; at most 128 characters."""

Identifier = Annotated[int, msgspec.Meta(ge=0, le=2**53 - 1)]
"""A whole number from 0 that every language's number type can hold exactly."""

# A duration from 0 to one hour, in milliseconds.
Milliseconds = Annotated[float, msgspec.Meta(ge=0, le=3.6e6)]


class _Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", omit_defaults=True):
    """The base of all messages; a receiver ignores unknown fields, so that a newer sender may add some."""


class Limits(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The limits that the server applies to this robot.

    ``max_commands_per_s`` limits all messages of the robot, after ``command_burst`` messages at once; 0 means
    no limit.  ``burst_commands_per_day`` limits the commands that it may send to `Welcome.burst_url`.
    """

    max_message_bytes: int
    max_in_flight: int
    max_commands_per_s: float = 0.0
    command_burst: int = 0
    burst_commands_per_day: int = 0


class Hello(_Message, frozen=True, kw_only=True, tag="hello"):
    """Robot begins the session: the first message on a socket."""

    protocol: int = PROTOCOL_VERSION
    sdk: Word = ""
    capabilities: Annotated[tuple[Word, ...], msgspec.Meta(max_length=32)] = ()


class Welcome(_Message, frozen=True, kw_only=True, tag="welcome"):
    """Server answers a Hello with its name and its limits.

    ``token_s``: seconds until the server closes the socket, unless a fresh token arrives before.
    ``burst_url``: address to which the robot may send commands by HTTP while no server answers in time, or a
    path at the address of the servers.  ``tenant`` and ``scopes`` are those of the robot's token; an empty
    ``scopes`` allows everything.
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
    """Robot calls a service.  The service determines the type of ``payload``.

    ``deadline_ms`` counts from the arrival at the server.  A command with a higher ``seq`` replaces a waiting
    command of the same ``stream``, unless the waiting one has ``keep`` set.
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
    """Robot cancels the command ``id``, which reported progress; its answer may arrive nevertheless."""

    id: Identifier


class Progress(_Message, frozen=True, kw_only=True, tag="progress"):
    """Server reports the progress of a long command: the part *done* (0..1), and *what* was done last.

    It is sent to robots whose Hello names the capability ``progress``; the first one confirms the command.
    """

    id: int
    done: float
    what: str = ""


class Result(_Message, frozen=True, kw_only=True, tag="result"):
    """Server answers a command.  ``received_s`` and ``sent_s`` are readings of the server's clock.

    ``object`` is the sha256 of a reply that is stored as an object; ``reply`` is absent if it is too large
    for a message.
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
    """Server reports why a command, or without ``id`` a message or the session, failed."""

    id: int | None = None
    code: str
    message: str
    hint: str = ""
    retry_after_ms: float | None = None
    server: str = ""
    trace: str = ""


class Move(_Message, frozen=True, kw_only=True, tag="move"):
    """Server asks the robot to open another socket within ``within_ms``, and then to close this one."""

    reason: str
    within_ms: float


class Ping(_Message, frozen=True, kw_only=True, tag="ping"):
    """Robot sends ``sent_s``, the time of its own clock in seconds; the server answers with a Pong."""

    sent_s: float


class Pong(_Message, frozen=True, kw_only=True, tag="pong"):
    """Server answers a Ping: with the robot's ``sent_s``, and two times of the server's clock in seconds.

    ``received_s`` is the time at which the Ping arrived, ``answered_s`` that at which this message was sent.
    """

    sent_s: float
    received_s: float
    answered_s: float


class Renew(_Message, frozen=True, kw_only=True, tag="renew"):
    """Robot sends a fresh token, so that the socket stays open after the first token expires."""

    token: Annotated[str, msgspec.Meta(max_length=65536)]


class Renewed(_Message, frozen=True, kw_only=True, tag="renewed"):
    """Server accepted the fresh token of a Renew, which expires ``token_s`` seconds after this message."""

    token_s: float


class Subscribe(_Message, frozen=True, kw_only=True, tag="subscribe"):
    """Robot subscribes to a topic, and first receives its present state.

    Only robots whose Hello names the capability ``updates`` may subscribe.  ``id`` differs from the ids of
    the robot's commands; a refusal is a Failure with this ``id``.
    """

    id: Identifier
    topic: Topic


class Unsubscribe(_Message, frozen=True, kw_only=True, tag="unsubscribe"):
    """Robot ends the subscription ``id``; an update that was sent before may still arrive."""

    id: Identifier


class Update(_Message, frozen=True, kw_only=True, tag="update"):
    """Server sends the newest value of one *key* of a topic, which replaces older values of the key.

    ``seq`` counts all values of the subscription from 1; a gap is the number of values that newer ones
    replaced before they were sent.
    """

    id: int
    topic: str
    seq: int
    key: str = ""
    payload: Any = None


# A message that robots send, and one that servers send.
FromRobot = Hello | Command | Ping | Cancel | Renew | Subscribe | Unsubscribe
FromServer = Welcome | Result | Failure | Move | Pong | Progress | Renewed | Update
Message = FromRobot | FromServer
