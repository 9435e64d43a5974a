"""Payloads that are encoded once and sent many times: for load generators, which must be cheap.

The message is the same to the server as if it had been encoded whole.  Promises no state between
messages and that a payload which was prepared for one codec is not sent with another.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.errors import BadMessage
from rse_pf.wire import arrays
from rse_pf.wire.codec import Codec
from rse_pf.wire.messages import Command

__all__ = ["PreencodedCommand", "encode_command", "prepare"]

_LEVEL = 6
_ENVELOPE_LEVEL, _ENVELOPE_MEMORY = 1, 1
_HEADER = b"\x78\x9c"
_BEFORE, _AFTER = b',"payload":', b"}"

_encode_json = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
_encode_binary = msgspec.msgpack.Encoder(enc_hook=arrays.binary_encode_hook).encode


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreencodedCommand:
    """An encoded payload; ``deflated`` is empty unless the codec compresses."""

    codec: str
    encoded: bytes
    deflated: bytes = b""


def prepare(codec: Codec, payload: Any) -> PreencodedCommand:
    """Encode *payload* for *codec*; raises BadMessage if it does not travel in messages."""
    try:
        encoded = _encode_binary(payload) if codec.name == "bin" else _encode_json(payload)
    except (RecursionError, ValueError, TypeError, OverflowError) as error:
        raise BadMessage(f"a payload cannot be encoded: {str(error)[:150]}") from error
    return PreencodedCommand(
        codec=codec.name, encoded=encoded, deflated=_flushed(encoded) if codec.name == "zlib" else b""
    )


def encode_command(codec: Codec, command: Command) -> bytes:
    """Return the WebSocket message of *command*, whose payload may be prepared.

    With zlib the envelope is deflated, the payload's blocks are appended and the checksum is made anew: a
    stream may hold blocks of several compressors as long as none refers to what came before itself.

    Raises:
        BadMessage: It cannot be said, or was prepared for another codec.

    Source:
        RFC 1950 and 1951.
    """
    payload = command.payload
    if not isinstance(payload, PreencodedCommand):
        return codec.encode(command)
    if payload.codec != codec.name:
        raise BadMessage(
            f"a payload prepared for {payload.codec} cannot travel as {codec.name}",
            hint="prepare it with the codec of the connection",
        )
    if codec.name != "zlib":
        return codec.encode(msgspec.structs.replace(command, payload=msgspec.Raw(payload.encoded)))
    envelope = _encode_json(msgspec.structs.replace(command, payload=None))[:-1] + _BEFORE
    deflate = zlib.compressobj(_ENVELOPE_LEVEL, zlib.DEFLATED, -9, _ENVELOPE_MEMORY)
    checksum = zlib.adler32(_AFTER, zlib.adler32(payload.encoded, zlib.adler32(envelope)))
    return b"".join(
        (
            _HEADER,
            deflate.compress(envelope),
            deflate.flush(zlib.Z_SYNC_FLUSH),
            payload.deflated,
            _CLOSING,
            checksum.to_bytes(4, "big"),
        )
    )


def _flushed(text: bytes) -> bytes:
    """Return *text* as deflate blocks that end on a byte and refer to nothing before them."""
    deflate = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return deflate.compress(text) + deflate.flush(zlib.Z_SYNC_FLUSH)


def _closed(text: bytes) -> bytes:
    deflate = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return deflate.compress(text) + deflate.flush()


_CLOSING = _closed(_AFTER)
