"""Look at a command's id and service without reading its payload, and refuse it at the least cost.

A server that is behind must say no for much less than it takes to say yes.  Promises to judge nothing: what
is not recognised at a glance is left to `Codec.decode_from_robot`, and what is may still be bad.
"""

from __future__ import annotations

import re
import zlib
from typing import NamedTuple

import msgspec

from rse_pf.wire.codec import Codec
from rse_pf.wire.messages import Failure

__all__ = ["Envelope", "encode_refusal", "peek"]

_MAX_GLANCED_BYTES = 512
_INFLATED_BYTES = 160
"""The head of a command as our robots write it: type, id, and a service of at most 64 letters."""

_HEAD = re.compile(
    rb'\{"type":"command","id":(0|[1-9][0-9]{0,15}),"service":"([\x20-\x21\x23-\x5b\x5d-\x7e]{1,64})"[,}]'
)


class _Command(msgspec.Struct, frozen=True, kw_only=True, tag="command", tag_field="type"):
    id: int
    service: str


_decode_binary = msgspec.msgpack.Decoder(_Command).decode
_encode_json = msgspec.json.Encoder().encode


class Envelope(NamedTuple):
    """What a refusal has to name."""

    id: int
    service: str


def peek(codec: Codec, data: bytes) -> Envelope | None:
    """Return id and service of the command in *data*, None if that takes more than a glance."""
    if codec.name == "bin":
        try:
            command = _decode_binary(data)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
            return None
        return Envelope(command.id, command.service) if 0 <= command.id < 2**53 else None
    head = data[:_MAX_GLANCED_BYTES]
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
    """Return the message of *failure*; with zlib stored, not deflated: 180 bytes instead of 150.

    Source:
        RFC 1951, Sect. 3.2.4.
    """
    if codec.name != "zlib":
        return codec.encode(failure)
    stream = zlib.compressobj(0, zlib.DEFLATED, 9, 1)
    return stream.compress(_encode_json(failure)) + stream.flush()
