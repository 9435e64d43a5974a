"""The protocol between robots and servers: messages, codecs, and the rules of both sides of a session.

Everything here works on values and bytes; sockets, clocks and services do not belong here.
"""

from rse_pf.wire.codec import CODECS, SUBPROTOCOLS, Codec, as_type, codec_for, make_codec
from rse_pf.wire.messages import (
    PROTOCOL_VERSION,
    Cancel,
    Command,
    Failure,
    FromRobot,
    FromServer,
    Hello,
    Limits,
    Message,
    Move,
    Ping,
    Pong,
    Progress,
    Renew,
    Renewed,
    Result,
    Subscribe,
    Unsubscribe,
    Update,
    Welcome,
)

__all__ = [
    "CODECS",
    "PROTOCOL_VERSION",
    "SUBPROTOCOLS",
    "Cancel",
    "Codec",
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
    "as_type",
    "codec_for",
    "make_codec",
]
