"""The wire between robots and servers: messages, codecs and the session rules."""

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
    Result,
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
    "Result",
    "Welcome",
    "as_type",
    "codec_for",
    "make_codec",
]
