"""Payloads that are encoded once and sent many times, which keeps load generators cheap.

The server decodes the same message as if it had been encoded as a whole.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.errors import BadMessage
from rse_pf.wire import arrays
from rse_pf.wire.codec import Codec, deflated
from rse_pf.wire.messages import Command

__all__ = ["PreencodedCommand", "encode_command", "encode_payload", "preencode"]

_ENVELOPE_LEVEL = 1  # level of zlib: an envelope has some 100 bytes
_ENVELOPE_MEMORY = 1  # memory level of zlib, the smallest: the compressor is made for each command
_HEADER = b"\x78\x9c"  # of a zlib stream (RFC 1950)
_BEFORE = b',"payload":'  # text of a command before the payload
_AFTER = b"}"  # text of a command after the payload

_encode_json = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
_encode_binary = msgspec.msgpack.Encoder(enc_hook=arrays.binary_encode_hook).encode


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreencodedCommand:
    """An encoded payload; ``deflated`` is empty unless the codec compresses."""

    codec: str
    encoded: bytes
    deflated: bytes = b""


def preencode(codec: Codec, payload: Any) -> PreencodedCommand:
    """Encode *payload* for *codec*; raises BadMessage if it cannot be encoded."""
    encoded = encode_payload(codec, payload)
    blocks = _blocks(encoded, zlib.Z_SYNC_FLUSH) if codec.name == "zlib" else b""
    return PreencodedCommand(codec=codec.name, encoded=encoded, deflated=blocks)


def encode_payload(codec: Codec, payload: Any) -> bytes:
    """Return *payload* as a message of *codec* contains it, not deflated; raises BadMessage."""
    try:
        return _encode_binary(payload) if codec.name == "bin" else _encode_json(payload)
    except (RecursionError, ValueError, TypeError, OverflowError) as error:
        raise BadMessage(f"a payload cannot be encoded: {str(error)[:150]}") from error


def encode_command(codec: Codec, command: Command) -> bytes:
    """Return the WebSocket message of *command*, whose payload may be a `PreencodedCommand`.

    With zlib the envelope is deflated, the payload's blocks are appended and the checksum is recomputed: a
    stream may hold blocks of several compressors if none refers to data before its own.

    Raises:
        BadMessage: It cannot be encoded, or was encoded for another codec.

    Source:
        RFC 1950 and 1951.
    """
    payload = command.payload
    if not isinstance(payload, PreencodedCommand):
        return codec.encode(command)
    if payload.codec != codec.name:
        raise BadMessage(
            f"a payload encoded for {payload.codec} cannot be sent as {codec.name}",
            hint="encode it with the codec of the connection",
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


def _blocks(text: bytes, mode: int) -> bytes:
    """Return *text* as deflate blocks that end as *mode* says and refer to nothing before them."""
    return deflated(text, mode=mode, window_bits=-zlib.MAX_WBITS)


_CLOSING = _blocks(_AFTER, zlib.Z_FINISH)
