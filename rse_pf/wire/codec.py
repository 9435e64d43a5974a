"""Encode and decode messages: JSON, JSON with zlib (as in the paper), or MessagePack with raw arrays.

Input is untrusted: the limits are checked before or while decoding, and only errors of `rse_pf.errors` are
raised.  A codec keeps no state between messages.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Protocol, TypeVar, get_args

import msgspec

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded, RsePfError, UnsupportedProtocol
from rse_pf.limits.budget import (
    Budget,
    check_json,
    check_json_containers,
    check_msgpack,
    check_size,
    inflate_short,
    inflate_up_to,
    inflate_within,
)
from rse_pf.wire import arrays
from rse_pf.wire.messages import Command, FromRobot, FromServer, Message

__all__ = [
    "CODECS",
    "SUBPROTOCOLS",
    "Codec",
    "ReadFirst",
    "as_type",
    "codec_for",
    "deflated",
    "make_codec",
    "stored",
]

T = TypeVar("T")

SUBPROTOCOLS = {
    "zlib": "rse-pf.v1.json+zlib",
    "json": "rse-pf.v1.json",
    "bin": "rse-pf.v1.bin",
}
"""By name of a codec: its WebSocket sub-protocol."""

CODECS = tuple(SUBPROTOCOLS)
"""The names of all codecs."""
# By WebSocket sub-protocol: the name of its codec.
_CODEC_NAMES = {protocol: name for name, protocol in SUBPROTOCOLS.items()}

# zlib level of a robot's text messages.  A robot's uplink is slower than its processor: at level 1 a command
# is 6 % longer.
_LEVEL = 6
# zlib level of a robot's messages that are mostly decimal numbers, used with the strategy Z_FILTERED.  Short
# repetitions do not shorten such texts: without them a command of 200 matches is 1.5 % shorter, takes the
# robot as long, and is inflated by the server in two thirds of the time.
_LEVEL_OF_NUMBERS = 4
# A text is mostly decimal numbers if it has a comma for at most this many bytes.
_BYTES_PER_NUMBER = 16

# zlib level of a server's messages: level 6 would save 5 of 794 bytes, and take a third more time.
_REPLY_LEVEL = 1

# A server's message with fewer bytes is sent as a zlib stream without compression.  Compressing the reply to
# 200 matches from 1,520 to 860 bytes would save one packet, but take 10 us: twice the rest of its encoding.
_STORED_BYTES = 2_800
# First bytes of a zlib stream that consists of one block without compression (RFC 1950 and 1951).
_STORED_HEAD = b"\x78\x01\x01"
# Compressed messages with more bytes than this are inflated by zlib, not by isal: isal takes 0.4 us for an
# empty block, so a hostile message of this size takes it 5 ms.
_MAX_FAST_BYTES = 16_384

# Types of decoded values that hold other values.
_CONTAINERS = frozenset((dict, list, tuple))
# Returns whether none of some types is in `_CONTAINERS`.
_is_flat = _CONTAINERS.isdisjoint
# Types of the messages that robots send.
_FROM_ROBOT = frozenset(get_args(FromRobot))
_UNDECODABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, OverflowError)
"""Exceptions that decoders of msgspec raise for invalid bytes, with their subclasses."""
# Exceptions that encoders of msgspec raise for values that cannot be encoded.
_UNENCODABLE = (RecursionError, ValueError, TypeError, OverflowError)


ReadFirst = Callable[[bytes | bytearray], Command | None]
"""Reads a robot's message (inflated) at less cost than the codec, if it is a command of one certain service.

Returns the command, or None if the codec has to read the message."""


class Codec(Protocol):
    """Encodes and decodes messages; ``is_text`` is whether they are sent as WebSocket text messages."""

    name: str
    is_text: bool

    def encode(self, message: Message) -> bytes:
        """Return *message* as the bytes of a WebSocket message; raises BadMessage if it cannot be encoded."""

    def decode_from_robot(self, data: bytes) -> FromRobot:
        """Return the message that a robot sent as *data*; raises BadMessage or LimitExceeded."""

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        """Return the message that a robot sent as *data*, None if it has more than *max_bytes* inflated.

        Raises:
            BadMessage: As for `decode_from_robot`.
            LimitExceeded: As for `decode_from_robot`.
        """

    def decode_from_server(self, data: bytes) -> FromServer:
        """Return the message that a server sent as *data*; raises BadMessage or LimitExceeded."""


def make_codec(
    name: str,
    limits: SessionSettings | None = None,
    *,
    zlib_library: ModuleType = zlib,
    read_first: ReadFirst | None = None,
) -> Codec:
    """Return the codec called *name*: ``zlib``, ``json`` or ``bin``.

    Args:
        name: Name of the codec.
        limits: Limits of the messages that are decoded; None means the defaults.
        zlib_library: The module that compresses and inflates short messages: ``zlib`` or ``isal.isal_zlib``.
        read_first: Reads a robot's message before the codec does; None if only the codec reads messages.

    Raises:
        UnsupportedProtocol: There is no such codec.
    """
    if name not in CODECS:
        raise UnsupportedProtocol(f"no codec named {name!r}", hint=f"choose one of {', '.join(CODECS)}")
    session = limits or SessionSettings()
    if name == "bin":
        return _BinaryCodec(session, read_first)
    return _JsonCodec(session, name == "zlib", zlib_library, read_first)


def as_type(value: Any, kind: type[T]) -> T:
    """Return *value*, the ``payload`` or ``reply`` of a message, as the type *kind* with float64 arrays.

    Raises:
        BadMessage: *value* does not fit *kind*.
    """
    try:
        return msgspec.convert(value, kind, dec_hook=arrays.decode_hook)
    except RsePfError:
        raise
    except _UNDECODABLE as error:
        raise _undecodable_error(error) from error


def codec_for(offered: list[str]) -> str | None:
    """Return the name of the codec of the first supported sub-protocol in *offered*; None if none is."""
    for protocol in offered:
        if protocol in _CODEC_NAMES:
            return _CODEC_NAMES[protocol]
    return None


def stored(text: bytes) -> bytes:
    """Return *text* as a zlib stream without compression, which costs little time.

    Source:
        RFC 1950, and RFC 1951, Sect. 3.2.4.
    """
    size = len(text)
    if size > 0xFFFF:  # one block does not hold it
        return zlib.compress(text, 0)
    return b"".join(
        (
            _STORED_HEAD,
            size.to_bytes(2, "little"),
            (size ^ 0xFFFF).to_bytes(2, "little"),
            text,
            zlib.adler32(text).to_bytes(4, "big"),
        )
    )


def deflated(text: bytes, *, mode: int = zlib.Z_FINISH, window_bits: int = zlib.MAX_WBITS) -> bytes:
    """Return the *text* of a robot's message as a deflate stream, by default a complete zlib stream.

    Args:
        text: Its kind, mostly numbers or not, selects the level and the strategy.
        mode: How the stream ends, a flush mode of zlib.
        window_bits: ``wbits`` of zlib; a negative value makes a raw deflate stream.
    """
    are_numbers = text.count(b",") * _BYTES_PER_NUMBER > len(text)
    level, strategy = (
        (_LEVEL_OF_NUMBERS, zlib.Z_FILTERED) if are_numbers else (_LEVEL, zlib.Z_DEFAULT_STRATEGY)
    )
    stream = zlib.compressobj(level, zlib.DEFLATED, window_bits, zlib.DEF_MEM_LEVEL, strategy)
    return stream.compress(text) + stream.flush(mode)


class _JsonCodec:
    """The codecs ``json`` and, with *is_compressed*, ``zlib``."""

    def __init__(
        self,
        limits: SessionSettings,
        is_compressed: bool,
        zlib_library: ModuleType,
        read_first: ReadFirst | None,
    ) -> None:
        self.name = "zlib" if is_compressed else "json"
        self.is_text = not is_compressed
        self._budget = Budget.of_messages(limits)
        self._is_compressed = is_compressed
        self._zlib = zlib_library
        self._read_first = read_first
        self._encode = msgspec.json.Encoder(enc_hook=arrays.json_encode_hook).encode
        self._from_robot = msgspec.json.Decoder(FromRobot).decode
        self._from_server = msgspec.json.Decoder(FromServer).decode

    def encode(self, message: Message) -> bytes:
        try:
            data = self._encode(message)
        except _UNENCODABLE as error:
            raise _unencodable_error(message, error) from error
        if not self._is_compressed:
            return data
        if type(message) in _FROM_ROBOT:
            return deflated(data)
        if len(data) < _STORED_BYTES:
            return stored(data)
        compressed: bytes = self._zlib.compress(data, _REPLY_LEVEL)
        return compressed

    def decode_from_robot(self, data: bytes) -> FromRobot:
        return self._read(self._open(data))

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        if not self._is_compressed:
            return None if len(data) > max_bytes else self.decode_from_robot(data)
        check_size(data, self._budget)
        text = inflate_up_to(data, max_bytes, self._zlib)
        return None if text is None else self._read(text)

    def decode_from_server(self, data: bytes) -> FromServer:
        text = self._open(data)
        check_json_containers(text, self._budget)
        message: FromServer = _decode_guarded(self._from_server, text)
        return message

    def _open(self, data: bytes) -> bytes | bytearray:
        check_size(data, self._budget)
        if not self._is_compressed:
            return data
        if len(data) > _MAX_FAST_BYTES:
            return inflate_within(data, self._budget)
        return inflate_short(data, self._budget, self._zlib)

    def _read(self, text: bytes | bytearray) -> FromRobot:
        if self._read_first is not None and (command := self._read_first(text)) is not None:
            return command
        check_json(text, self._budget)
        message: FromRobot = _decode_guarded(self._from_robot, text)
        return message


class _BinaryCodec:
    """The codec ``bin``: MessagePack with raw arrays."""

    name = "bin"
    is_text = False

    def __init__(self, limits: SessionSettings, read_first: ReadFirst | None) -> None:
        self._budget = Budget.of_messages(limits)
        self._read_first = read_first
        self._encode = msgspec.msgpack.Encoder(enc_hook=arrays.binary_encode_hook).encode
        self._from_robot = msgspec.msgpack.Decoder(FromRobot, ext_hook=arrays.extension_hook).decode
        self._from_server = msgspec.msgpack.Decoder(FromServer, ext_hook=arrays.extension_hook).decode

    def encode(self, message: Message) -> bytes:
        try:
            return self._encode(message)
        except _UNENCODABLE as error:
            raise _unencodable_error(message, error) from error

    def decode_from_robot(self, data: bytes) -> FromRobot:
        check_size(data, self._budget)
        if self._read_first is not None and (command := self._read_first(data)) is not None:
            return command
        is_checked = check_msgpack(data, self._budget)
        message: FromRobot = _decode_guarded(self._from_robot, data)
        if not is_checked and type(message) is Command and type(message.payload) in _CONTAINERS:
            _check_nesting(message.payload, self._budget.depth)
        return message

    def decode_short_from_robot(self, data: bytes, max_bytes: int) -> FromRobot | None:
        return None if len(data) > max_bytes else self.decode_from_robot(data)

    def decode_from_server(self, data: bytes) -> FromServer:
        check_size(data, self._budget)
        message: FromServer = _decode_guarded(self._from_server, data)
        _check_nesting(getattr(message, "reply", None), self._budget.depth)
        return message


def _decode_guarded(decode: Callable[[Any], Any], data: Any) -> Any:
    """Return what *decode* returns for *data*; an exception of the decoder becomes BadMessage."""
    try:
        return decode(data)
    except RsePfError:
        raise
    except _UNDECODABLE as error:
        raise _undecodable_error(error) from error


def _undecodable_error(error: Exception) -> BadMessage:
    """Return the BadMessage that reports *error*, an exception of a decoder."""
    if isinstance(error, msgspec.ValidationError):
        return BadMessage(str(error)[:200], hint="compare it with docs/protocol.md")
    if isinstance(error, (msgspec.DecodeError, UnicodeDecodeError)):
        return BadMessage(f"not a message: {str(error)[:150]}", hint="send what the agreed sub-protocol says")
    return BadMessage(
        "a message is nested too deeply or holds a number out of range", hint="send flat lists of numbers"
    )


def _unencodable_error(message: Message, error: Exception) -> BadMessage:
    return BadMessage(
        f"a {type(message).__name__} cannot be encoded: {str(error)[:150]}",
        hint="send numbers, strings, lists, arrays and structs",
    )


def _check_nesting(value: Any, max_depth: int) -> None:
    """Raise LimitExceeded if *value*, a part of a decoded message, is nested too deeply.

    The message itself is the first of at most *max_depth* levels.
    """
    if max_depth > 1 and type(value) is dict and _is_flat(map(type, (*value, *value.values()))):
        return  # most values are such flat maps, for which the loop below takes three times as long
    layer = [value] if type(value) in _CONTAINERS else []
    for _ in range(max_depth - 1):
        layer = [
            item
            for box in layer
            for item in (itertools.chain(box, box.values()) if type(box) is dict else box)
            if type(item) in _CONTAINERS
        ]
        if not layer:
            return
    raise LimitExceeded(f"a message is nested deeper than {max_depth}", hint="send flat lists")
