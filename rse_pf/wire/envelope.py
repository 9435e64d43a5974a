"""Read a command's id and service without its payload, and encode its refusal, both at the least cost.

A server under overload must refuse a command for much less than it costs to accept one.  A message whose
envelope is not recognised is left to `Codec.decode_from_robot`; one that is recognised may still be invalid.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from rse_pf.wire.codec import Codec, stored
from rse_pf.wire.messages import Failure

__all__ = ["Envelope", "encode_refusal", "peek"]

_MAX_PEEKED_BYTES = 512
# The start of a command as the SDK writes it: type, id, and a service of at most 64 characters.
_INFLATED_BYTES = 160

_HEAD = re.compile(
    rb'\{"type":"command","id":(0|[1-9][0-9]{0,15}),"service":"([\x20-\x21\x23-\x5b\x5d-\x7e]{1,64})"[,}]'
)


class _Command(msgspec.Struct, frozen=True, kw_only=True, tag="command", tag_field="type"):
    id: int
    service: str


_decode_binary = msgspec.msgpack.Decoder(_Command).decode
_encode_json = msgspec.json.Encoder().encode


class Envelope(NamedTuple):
    """The fields of a command that its refusal names."""

    id: int
    service: str


def peek(codec: Codec, data: bytes) -> Envelope | None:
    """Return id and service of the command in *data*, None if they are not at its start."""
    own: Callable[[bytes], Envelope | None] | None = getattr(codec, "peek", None)
    if own is not None:  # its messages do not begin like a command
        return own(data)
    if codec.name == "bin":
        try:
            command = _decode_binary(data)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
            return None
        return Envelope(command.id, command.service) if 0 <= command.id < 2**53 else None
    head = data[:_MAX_PEEKED_BYTES]
    if codec.name == "zlib":
        try:
            head = zlib.decompressobj().decompress(head, _INFLATED_BYTES)
        except zlib.error:
            return None
    found = _HEAD.match(head)
    if found is None:
        return None
    identity, service = found.groups()
    return Envelope(int(identity), service.decode()) if len(identity) < 16 or int(identity) < 2**53 else None


def encode_refusal(codec: Codec, failure: Failure) -> bytes:
    """Return the message of *failure*; with zlib it is stored, not deflated: 180 bytes instead of 150."""
    if codec.name != "zlib":
        return codec.encode(failure)
    return stored(_encode_json(failure))
