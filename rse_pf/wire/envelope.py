"""Read the id and the service of a command without its payload, and encode its refusal, both at little cost.

A server under overload must refuse a command in much less time than it takes to answer one.  `peek` reads id
and service of most commands; a message that it does not recognise is left to `Codec.decode_from_robot`, and
one that it recognises may still be invalid.  `undecodable_id` reads the id of a message that the codec
refused, from a bounded number of its first bytes.
"""

from __future__ import annotations

import itertools
import re
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec

from rse_pf.errors import ProtocolError
from rse_pf.limits.budget import Budget, announced_values, measure_msgpack, small_text
from rse_pf.wire.codec import Codec, stored
from rse_pf.wire.messages import Failure

__all__ = ["Envelope", "encode_refusal", "peek", "undecodable_id"]

# Most bytes at the start of a message in which the id and the service are searched.
_MAX_PEEKED_BYTES = 512
# Bytes to which `peek` inflates the start of a message: enough for the longest id and service.
_INFLATED_BYTES = 160

# The start of a command as the SDK writes it: type, id, and a service of at most 64 characters.  Some
# encoders put a space after each colon and comma.
_HEAD = re.compile(
    rb'\{"type": ?"command", ?"id": ?(0|[1-9][0-9]{0,15}), ?"service": ?'
    rb'"([\x20-\x21\x23-\x5b\x5d-\x7e]{1,64})"[,}]'
)

# One member of a JSON object whose value is neither a list nor an object; a comma or } follows it.
_MEMBER = re.compile(
    rb'\s*[{,]\s*"((?:[^"\\]|\\.)*)"\s*:\s*("(?:[^"\\]|\\.)*"|-?[0-9][0-9.eE+-]*|true|false|null)\s*(?=[,}])'
)
# Compressed bytes of a damaged message that are inflated at once, so that the text before the damage is read.
_INFLATED_PIECE_BYTES = 64
# Fields of a message that are searched for its type and id.
_MAX_FIELDS = 16
_MAP_HEAD_BYTES = {0xDE: 3, 0xDF: 5}
"""By first byte of a MessagePack map with more than 15 members: bytes before its first member."""
_WITH_ANSWER = ("command", "subscribe")
"""Types of the robot's messages whose ``id`` an answer repeats."""
_SCALAR = Budget(
    wire_bytes=_MAX_PEEKED_BYTES, inflated_bytes=_MAX_PEEKED_BYTES, inflate_ratio=1.0,
    free_bytes=_MAX_PEEKED_BYTES, depth=1, containers=0, values=4, mixed_values=4,
    memory_bytes=_MAX_PEEKED_BYTES,
)  # fmt: skip
"""Limits of the value of one field before the id: a number or a short text, no list and no map."""


class _Command(msgspec.Struct, frozen=True, kw_only=True, tag="command", tag_field="type"):
    id: int
    service: str


_decode_binary = msgspec.msgpack.Decoder(_Command).decode
_encode_json = msgspec.json.Encoder().encode


class Envelope(NamedTuple):
    """The id and the service of a command, which its refusal repeats."""

    id: int
    service: str


def peek(codec: Codec, data: bytes) -> Envelope | None:
    """Return the id and the service of the command in *data*, without a check of the rest.

    None if *data* does not begin with them in the form that the SDK writes.
    """
    own: Callable[[bytes], Envelope | None] | None = getattr(codec, "peek", None)
    if own is not None:  # the messages of this codec have a form that only the codec itself can read
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
    match = _HEAD.match(head)
    if match is None:
        return None
    identity, service = match.groups()
    return Envelope(int(identity), service.decode()) if len(identity) < 16 or int(identity) < 2**53 else None


def undecodable_id(codec: Codec, data: bytes) -> int | None:
    """Return the id of the command or subscription in *data*, a message that *codec* refused to decode.

    None if the first bytes hold no id, if a list or an object comes before ``type`` and ``id``, or if the
    message has another type: the refusal of a ``cancel`` must not end the command whose id it repeats.
    """
    is_binary = codec.name == "bin"
    decode: Callable[[bytes], Any] = msgspec.msgpack.decode if is_binary else msgspec.json.decode
    members: dict[str, Any] = {}
    try:
        fields = _binary_fields(data) if is_binary else _json_fields(_text_head(codec, data))
        for name, value in itertools.islice(fields, _MAX_FIELDS):
            if name in ("type", "id"):
                members[name] = decode(value)
            if len(members) == 2:
                break
    except (ProtocolError, msgspec.DecodeError, ValueError):
        return None
    identity = members.get("id")
    if members.get("type") not in _WITH_ANSWER or type(identity) is not int:
        return None
    return identity if 0 <= identity < 2**53 else None


def _text_head(codec: Codec, data: bytes) -> bytes:
    """Return the first `_MAX_PEEKED_BYTES` of a JSON message, inflated for ``zlib``.

    Of a damaged zlib stream, the text before the damage is returned.
    """
    head = data[:_MAX_PEEKED_BYTES]
    if codec.name != "zlib":
        return head
    stream, text = zlib.decompressobj(), b""
    for at in range(0, len(head), _INFLATED_PIECE_BYTES):
        left_bytes = _MAX_PEEKED_BYTES - len(text)
        if left_bytes <= 0:
            break
        try:
            text += stream.decompress(head[at : at + _INFLATED_PIECE_BYTES], left_bytes)
        except zlib.error:
            break
    return text


def _json_fields(head: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield name and value, as JSON, of the first members of an object, up to the first list or object."""
    at = 0
    while member := _MEMBER.match(head, at):
        at = member.end()
        yield member[1].decode("utf-8", "replace"), member[2]


def _binary_fields(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield name and value (MessagePack) of the fields at the start of a map.

    Nothing is yielded if *data* does not begin with a map.

    Raises:
        ProtocolError: A value is a list, a map or too long, or *data* end.
    """
    head = data[:_MAX_PEEKED_BYTES]
    if not head or not (0x80 <= head[0] < 0x90 or head[0] in _MAP_HEAD_BYTES):
        return
    at = _MAP_HEAD_BYTES.get(head[0], 1)
    for _ in range(announced_values(head, 0) // 2):
        name, at = small_text(head, at)
        end = measure_msgpack(head, at, _SCALAR)
        yield name, head[at:end]
        at = end


def encode_refusal(codec: Codec, failure: Failure) -> bytes:
    """Return *failure* as a WebSocket message of *codec*; with ``zlib`` it is not compressed, to save time.

    Such a message has 180 bytes instead of 150.
    """
    if codec.name != "zlib":
        return codec.encode(failure)
    return stored(_encode_json(failure))
