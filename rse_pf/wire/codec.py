"""Bytes to messages and back: JSON, JSON+zlib (the paper's) and MessagePack with raw arrays.

Input is untrusted: limits hold *while* decoding, and only errors of `rse_pf.errors` are raised.  A codec
keeps no state between messages.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded, RsePfError, UnsupportedProtocol
from rse_pf.wire import arrays
from rse_pf.wire.messages import FromRobot, FromServer, Message
from rse_pf.wire.msgpack_limits import LIST_VALUES, MAP_VALUES, check_msgpack, too_many_values

__all__ = ["CODECS", "SUBPROTOCOLS", "Codec", "as_type", "codec_for", "make_codec"]

T = TypeVar("T")
Text = bytes | bytearray

SUBPROTOCOLS = {
    "zlib": "rse-pf.v1.json+zlib",
    "json": "rse-pf.v1.json",
    "bin": "rse-pf.v1.bin",
}
"""Short name to WebSocket sub-protocol, in the server's order of preference."""

CODECS = tuple(SUBPROTOCOLS)

# A robot's uplink is slower than its processor: at level 1 a command is 6 % longer.
_LEVEL = 6

# A server's messages are short: level 6 saves 5 of 794 bytes and costs a third more time.
_REPLY_LEVEL, _REPLY_WINDOW_BITS, _REPLY_MEMORY = 1, 12, 5

_PIECE_BYTES = 65536
# Bytes in memory per string, per number, per character of a text beyond ASCII, and per byte at worst.
_STRING_BYTES, _NUMBER_BYTES, _WIDE, _MAX_BYTES_PER_BYTE = 60, 32, 7, 8
_FEW_STRINGS = 2000
_NOT_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
_CONTAINERS = frozenset((dict, list, tuple))
_NOT_BRACKETS_OR_QUOTES = bytes(set(range(256)) - set(b'[]{}"'))
_NOT_MARKS_OR_QUOTES = bytes(set(range(256)) - set(b',:[]{}"'))


class Codec(Protocol):
    """One encoding of messages."""

    name: str
    is_text: bool

    def encode(self, message: Message) -> bytes:
        """Return the WebSocket message of *message*; raises BadMessage if it cannot be encoded."""

    def decode_from_robot(self, data: bytes) -> FromRobot:
        """Return what a robot sent; raises BadMessage or LimitExceeded."""

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        """Return what a robot sent, None if it is longer than *max_bytes*, inflated; raises the same."""

    def decode_from_server(self, data: bytes) -> FromServer:
        """Return what a server sent; raises BadMessage or LimitExceeded."""


def make_codec(name: str, limits: SessionSettings | None = None) -> Codec:
    """Return the codec called *name*: ``zlib``, ``json`` or ``bin``."""
    session = limits or SessionSettings()
    if name == "bin":
        return _BinaryCodec(session)
    if name in ("zlib", "json"):
        return _JsonCodec(session, compressed=name == "zlib")
    raise UnsupportedProtocol(f"no codec named {name!r}", hint=f"choose one of {', '.join(CODECS)}")


def as_type(value: Any, kind: type[T]) -> T:
    """Return a message's ``payload`` or ``reply`` as *kind*, its arrays as float64.

    Raises:
        BadMessage: It does not fit.
    """
    result: T = _guarded(lambda plain: msgspec.convert(plain, kind, dec_hook=arrays.decode_hook), value)
    return result


def codec_for(offered: list[str]) -> str | None:
    """Return the codec name of the first offered sub-protocol that is supported, else None."""
    names = {protocol: name for name, protocol in SUBPROTOCOLS.items()}
    return next((names[protocol] for protocol in offered if protocol in names), None)


class _JsonCodec:
    def __init__(self, limits: SessionSettings, *, compressed: bool) -> None:
        self.name = "zlib" if compressed else "json"
        self.is_text = not compressed
        self._limits = limits
        self._compressed = compressed
        self._encode = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
        self._from_robot = msgspec.json.Decoder(FromRobot).decode
        self._from_server = msgspec.json.Decoder(FromServer).decode

    def encode(self, message: Message) -> bytes:
        data = _encoded(self._encode, message)
        if not self._compressed:
            return data
        if isinstance(message, FromRobot):
            return zlib.compress(data, _LEVEL)
        stream = zlib.compressobj(_REPLY_LEVEL, zlib.DEFLATED, _REPLY_WINDOW_BITS, _REPLY_MEMORY)
        return stream.compress(data) + stream.flush()

    def decode_from_robot(self, data: bytes) -> FromRobot:
        return self._read(self._open(data))

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        text = _inflate_short(data, max_bytes) if self._compressed else data
        return None if text is None or len(text) > max_bytes else self._read(text)

    def decode_from_server(self, data: bytes) -> FromServer:
        text = self._open(data)
        _check_containers(text, self._limits)
        message: FromServer = _guarded(self._from_server, text)
        return message

    def _read(self, text: Text) -> FromRobot:
        _check_containers(text, self._limits)
        _check_values(text, self._limits.max_json_values)
        _check_memory(text, self._limits.max_json_memory_bytes)
        message: FromRobot = _guarded(self._from_robot, text)
        return message

    def _open(self, data: bytes) -> Text:
        _check_size(data, self._limits)
        return _inflate(data, self._limits) if self._compressed else data


class _BinaryCodec:
    name = "bin"
    is_text = False

    def __init__(self, limits: SessionSettings) -> None:
        self._limits = limits
        self._encode = msgspec.msgpack.Encoder(enc_hook=arrays.binary_encode_hook).encode
        self._from_robot = msgspec.msgpack.Decoder(FromRobot, ext_hook=arrays.extension_hook).decode
        self._from_server = msgspec.msgpack.Decoder(FromServer, ext_hook=arrays.extension_hook).decode

    def encode(self, message: Message) -> bytes:
        return _encoded(self._encode, message)

    def decode_from_robot(self, data: bytes) -> FromRobot:
        _check_size(data, self._limits)
        check_msgpack(data, self._limits)
        message: FromRobot = _guarded(self._from_robot, data)
        _check_nesting(getattr(message, "payload", None), self._limits.max_json_depth)
        return message

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        return None if len(data) > max_bytes else self.decode_from_robot(data)

    def decode_from_server(self, data: bytes) -> FromServer:
        _check_size(data, self._limits)
        message: FromServer = _guarded(self._from_server, data)
        _check_nesting(getattr(message, "reply", None), self._limits.max_json_depth)
        return message


def _guarded(decode: Callable[[Any], Any], data: Any) -> Any:
    """Decode *data*, turning every exception of the decoder into `BadMessage`."""
    try:
        return decode(data)
    except RsePfError:
        raise
    except msgspec.ValidationError as error:
        raise BadMessage(str(error)[:200], hint="compare it with docs/protocol.md") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BadMessage(
            f"not a message: {str(error)[:150]}", hint="is this the sub-protocol that was agreed?"
        ) from error
    except (RecursionError, ValueError, TypeError, OverflowError) as error:
        raise BadMessage(
            "a message is nested too deeply or holds a number out of range", hint="send flat lists of numbers"
        ) from error


def _encoded(encode: Callable[[Any], bytes], message: Message) -> bytes:
    try:
        return encode(message)
    except (RecursionError, ValueError, TypeError, OverflowError) as error:
        raise BadMessage(
            f"a {type(message).__name__} cannot be encoded: {str(error)[:150]}",
            hint="send numbers, strings, lists, arrays and structs",
        ) from error


def _check_size(data: bytes, limits: SessionSettings) -> None:
    if len(data) > limits.max_message_bytes:
        raise LimitExceeded(
            f"a message of {len(data)} bytes is above {limits.max_message_bytes}",
            hint="send large data to the data server and name it by digest",
        )


def _inflate(data: bytes, limits: SessionSettings) -> Text:
    # The ratio limits large results only: a text of an allowed size is accepted at any ratio.
    plain = limits.max_message_bytes
    max_bytes = min(limits.max_inflated_bytes, max(plain, int(len(data) * limits.max_inflate_ratio)))
    first = int(plain / limits.max_inflate_ratio)
    stream = zlib.decompressobj()
    try:
        # A decompression bomb is detected here, at a quarter of the cost of inflating all that is allowed.
        head = stream.decompress(data[:first], min(plain, max_bytes) + 1)
        if len(head) > min(plain, max_bytes):
            raise _bomb(data, plain)
        text: Text = head
        if len(data) > first:
            text = _rest(stream, head, stream.unconsumed_tail + data[first:], max_bytes)
    except zlib.error as error:
        raise _not_zlib() from error
    if len(text) > max_bytes:
        raise _bomb(data, max_bytes)
    if not stream.eof or stream.unused_data:
        raise _not_one_stream()
    return text


def _rest(stream: Any, head: bytes, data: bytes, max_bytes: int) -> bytearray:
    """Inflate piece by piece, because zlib would hold the text twice otherwise."""
    text = bytearray(head)
    while data and len(text) <= max_bytes:
        text += stream.decompress(data, min(_PIECE_BYTES, max_bytes + 1 - len(text)))
        data = stream.unconsumed_tail
    return text


def _inflate_short(data: bytes, max_bytes: int) -> bytes | None:
    stream = zlib.decompressobj()
    try:
        text = stream.decompress(data, max_bytes + 1)
    except zlib.error as error:
        raise _not_zlib() from error
    if len(text) > max_bytes:
        return None
    if not stream.eof or stream.unused_data:
        raise _not_one_stream()
    return text


def _not_zlib() -> BadMessage:
    return BadMessage("not a zlib stream", hint="is this the sub-protocol that was agreed?")


def _not_one_stream() -> BadMessage:
    return BadMessage("the zlib stream does not end with the message", hint="one stream for each message")


def _bomb(data: bytes, max_bytes: int) -> LimitExceeded:
    return LimitExceeded(f"{len(data)} bytes inflate to more than {max_bytes}", hint="send smaller messages")


def _check_containers(text: Text, limits: SessionSettings) -> None:
    """Check the number and depth of lists and objects before any is created.

    Brackets inside strings are told apart only if all brackets together exceed a limit.
    """
    max_depth, max_lists = limits.max_json_depth, limits.max_json_lists
    count = text.count(b"[") + text.count(b"{")
    if count <= max_depth:
        return
    if count <= max_lists and _depth(text.translate(None, _NOT_BRACKETS)) <= max_depth:
        return
    brackets = _without_strings(text, _NOT_BRACKETS_OR_QUOTES)
    if brackets.count(b"[") + brackets.count(b"{") > max_lists:
        raise LimitExceeded(
            f"JSON of more than {max_lists} lists and objects", hint="send flat lists of numbers"
        )
    if _depth(brackets) > max_depth:
        raise LimitExceeded(f"JSON is nested deeper than {max_depth}", hint="send flat lists")


def _check_values(text: Text, max_values: int) -> None:
    """Check the number of values before any is created; strings are told apart only above the limit."""
    if _values(text) >= max_values and _values(_without_strings(text, _NOT_MARKS_OR_QUOTES)) >= max_values:
        raise too_many_values(max_values)


def _check_memory(text: Text, max_bytes: int) -> None:
    """Check the memory that a message will take; estimate more exactly only above the limit."""
    if _MAX_BYTES_PER_BYTE * len(text) <= max_bytes:
        return
    strings, width = text.count(b'"') // 2, 1 if text.isascii() and b"\\u" not in text else _WIDE
    numbers = text.count(b",") + text.count(b":")
    other = len(text) + _STRING_BYTES * strings + _NUMBER_BYTES * max(0, numbers - strings)
    if other + width * len(text) <= max_bytes:
        return
    characters = len(text) if strings > _FEW_STRINGS or b'\\"' in text else _characters(text)
    if other + width * characters > max_bytes:
        raise LimitExceeded(
            f"a message that would take more than {max_bytes} bytes of memory",
            hint="send arrays of numbers, or large data to the data server",
        )


def _characters(text: Text) -> int:
    """Return the number of characters between quotes, none of which is escaped."""
    count, end = 0, -1
    while (begin := text.find(b'"', end + 1)) >= 0:
        end = text.find(b'"', begin + 1)
        if end < 0:
            return len(text)
        count += end - begin
    return count


def _values(text: Text) -> int:
    containers = LIST_VALUES * text.count(b"[") + MAP_VALUES * text.count(b"{")
    return text.count(b",") + text.count(b":") + containers


def _depth(brackets: Text) -> int:
    opening = np.isin(np.frombuffer(brackets, np.uint8), np.frombuffer(b"[{", np.uint8))
    return int(np.cumsum(np.where(opening, np.int8(1), np.int8(-1)), dtype=np.int32).max(initial=0))


def _without_strings(text: Text, dropped: bytes) -> bytes:
    marks = text.replace(b"\\\\", b"").replace(b'\\"', b"").translate(None, dropped)
    kept, is_inside = [], False
    for begin in range(0, len(marks), _PIECE_BYTES):
        signs: npt.NDArray[np.uint8] = np.frombuffer(marks[begin : begin + _PIECE_BYTES], np.uint8)
        quotes = signs == ord('"')
        inside = np.logical_xor.accumulate(quotes) ^ is_inside
        kept.append(signs[~(inside | quotes)].tobytes())
        is_inside = bool(inside[-1])
    return b"".join(kept)


def _check_nesting(value: Any, max_depth: int) -> None:
    """Apply the depth limit of JSON to a decoded value; the message itself is the first level."""
    layer = [value] if type(value) in _CONTAINERS else []
    for _ in range(max_depth - 1):
        layer = [
            each
            for box in layer
            for each in (itertools.chain(box, box.values()) if type(box) is dict else box)
            if type(each) in _CONTAINERS
        ]
        if not layer:
            return
    raise LimitExceeded(f"a message is nested deeper than {max_depth}", hint="send flat lists")
