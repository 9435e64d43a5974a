"""Read a command's id and service without its payload, and encode its refusal, both at the least cost.

A server under overload must refuse a command for much less than it costs to accept one.  A message whose
envelope is not recognised is left to `Codec.decode_from_robot`; one that is recognised may still be invalid.
Of a message that the codec refused only the id is read, from a bounded number of its first bytes.
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

_MAX_PEEKED_BYTES = 512
_INFLATED_BYTES = 160

# The start of a command as the SDK writes it: type, id, and a service of at most 64 characters.  Some
# encoders put a space behind each mark.
_HEAD = re.compile(
    rb'\{"type": ?"command", ?"id": ?(0|[1-9][0-9]{0,15}), ?"service": ?'
    rb'"([\x20-\x21\x23-\x5b\x5d-\x7e]{1,64})"[,}]'
)

# One member of a JSON object whose value is no list and no object, and the mark behind it.
_MEMBER = re.compile(
    rb'\s*[{,]\s*"((?:[^"\\]|\\.)*)"\s*:\s*("(?:[^"\\]|\\.)*"|-?[0-9][0-9.eE+-]*|true|false|null)\s*(?=[,}])'
)
_INFLATED_PIECE_BYTES = 64
_MAX_FIELDS = 16
_MAP_HEAD_BYTES = {0xDE: 3, 0xDF: 5}
"""Of the maps that are not short."""
_WITH_ANSWER = ("command", "subscribe")
"""The types whose id an answer names."""
_SCALAR = Budget(
    wire_bytes=_MAX_PEEKED_BYTES, inflated_bytes=_MAX_PEEKED_BYTES, inflate_ratio=1.0,
    free_bytes=_MAX_PEEKED_BYTES, depth=1, containers=0, values=4, mixed_values=4,
    memory_bytes=_MAX_PEEKED_BYTES,
)  # fmt: skip
"""What one field before the id may be: no list and no map."""


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
    match = _HEAD.match(head)
    if match is None:
        return None
    identity, service = match.groups()
    return Envelope(int(identity), service.decode()) if len(identity) < 16 or int(identity) < 2**53 else None


def undecodable_id(codec: Codec, data: bytes) -> int | None:
    """Return the id of the command or subscription in *data*, which *codec* refused; None if it has none.

    The id is read only from the first bytes, and only if `type` and `id` stand before every list and object.
    Any other message has no id here: what a ``cancel`` or ``unsubscribe`` names is not ended by its refusal.
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
    """Return the first characters of a JSON message; of a damaged zlib stream those before the damage."""
    head = data[:_MAX_PEEKED_BYTES]
    if codec.name != "zlib":
        return head
    stream, text = zlib.decompressobj(), b""
    for at in range(0, len(head), _INFLATED_PIECE_BYTES):
        room_bytes = _MAX_PEEKED_BYTES - len(text)
        if room_bytes <= 0:
            break
        try:
            text += stream.decompress(head[at : at + _INFLATED_PIECE_BYTES], room_bytes)
        except zlib.error:
            break
    return text


def _json_fields(head: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield name and text of the members at the start of an object, up to the first list or object."""
    at = 0
    while member := _MEMBER.match(head, at):
        at = member.end()
        yield member[1].decode("utf-8", "replace"), member[2]


def _binary_fields(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of the fields at the start of a map; raises ProtocolError at anything else."""
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
    """Return the message of *failure*; with zlib it is stored, not deflated: 180 bytes instead of 150."""
    if codec.name != "zlib":
        return codec.encode(failure)
    return stored(_encode_json(failure))
