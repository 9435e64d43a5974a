"""Payloads that are encoded once and sent in many commands, so that load generators need little CPU time.

A server decodes such a command exactly as one that was encoded as a whole.
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

_ENVELOPE_LEVEL = 1  # zlib level for the command without its payload, which has some 100 bytes
_ENVELOPE_MEMORY = 1  # smallest memory level of zlib: a compressor is made for each command
_HEADER = b"\x78\x9c"  # first bytes of a zlib stream (RFC 1950)
_BEFORE = b',"payload":'  # text of a command in JSON before the payload
_AFTER = b"}"  # text of a command in JSON after the payload

_encode_json = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
_encode_binary = msgspec.msgpack.Encoder(enc_hook=arrays.binary_encode_hook).encode


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreencodedCommand:
    """A payload that was encoded for the codec named ``codec``.

    ``encoded`` are its bytes without compression; ``deflated`` are its deflate blocks, empty unless the codec
    is ``zlib``.
    """

    codec: str
    encoded: bytes
    deflated: bytes = b""


def preencode(codec: Codec, payload: Any) -> PreencodedCommand:
    """Return *payload* encoded for *codec*; raises BadMessage if it cannot be encoded."""
    encoded = encode_payload(codec, payload)
    blocks = _blocks(encoded, zlib.Z_SYNC_FLUSH) if codec.name == "zlib" else b""
    return PreencodedCommand(codec=codec.name, encoded=encoded, deflated=blocks)


def encode_payload(codec: Codec, payload: Any) -> bytes:
    """Return the bytes of *payload* inside a message of *codec*, without compression; raises BadMessage."""
    try:
        return _encode_binary(payload) if codec.name == "bin" else _encode_json(payload)
    except (RecursionError, ValueError, TypeError, OverflowError) as error:
        raise BadMessage(f"a payload cannot be encoded: {str(error)[:150]}") from error


def encode_command(codec: Codec, command: Command) -> bytes:
    """Return the WebSocket message of *command*, whose payload may be a `PreencodedCommand`.

    With the codec ``zlib``, the command without its payload is compressed, the deflate blocks of the payload
    are appended, and the checksum of the whole is computed.  A zlib stream may consist of blocks of several
    compressors if no block refers to data of another compressor.

    Raises:
        BadMessage: The command cannot be encoded, or its payload was encoded for another codec.

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
    """Return *text* as raw deflate blocks that refer to no data before them; *mode* is their flush mode."""
    return deflated(text, mode=mode, window_bits=-zlib.MAX_WBITS)


# Deflate blocks of the text after the payload, which end the stream of a command.
_CLOSING = _blocks(_AFTER, zlib.Z_FINISH)
