"""Requests to one installed service and their answers, collected in a worker while an operator asks for it.

A recording is bounded in number, bytes and time.  It holds what the service was sent and what it answered: no
head of a message, no name of a robot, and no token; texts that look like a secret are replaced.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from rse_pf.errors import BadMessage, RsePfError
from rse_pf.wire.arrays import binary_encode_hook, extension_hook

__all__ = ["LEFT_OUT", "RecordedCall", "Recording", "recorded_calls", "without_secrets"]

LEFT_OUT = "[left out: it looks like a secret]"
"""Stands where a recording had a secret."""

_LENGTH = struct.Struct("<I")
_HINTS = ("eyJ", "earer", "EARER", "mz-", "MZ-")
"""One of them is in every text that `_SECRET` finds; looking for them first takes a hundredth of its time."""
_SECRET = re.compile(
    r"eyJ[\w-]{5,}\.[\w-]{5,}\.[\w-]*"  # a JSON Web Token
    r"|(?i:bearer)\s+[\w.~+/=-]{8,}"
    r"|(?i:x-amz-(?:signature|security-token|credential))=[^&\s\"']+"
)
_SECRET_NAME = re.compile(
    r"(?i)(?:.*[_-])?(?:token|authorization|password|passphrase|secret|credentials?|api[_-]?key|private[_-]?key)"
)


class RecordedCall(msgspec.Struct, frozen=True, array_like=True):
    """One request: the reply to it, or the code of the failure.

    ``secrets`` counts the values that were replaced by `LEFT_OUT`.
    """

    request: Any
    reply: Any
    failure: str | None
    compute_ms: float
    secrets: int


class Recording:
    """Collects calls until one of its limits is reached; `take` reads them as one stream of bytes."""

    def __init__(self, service: str, *, max_calls: int, max_bytes: int, until_s: float) -> None:
        """Begin an empty one of *service*, which ends at *until_s* (s, of the clock that `add` gets)."""
        self.service = service
        self.calls = 0
        self.left_out = 0
        """Calls that did not fit into the bytes that were left."""
        self._max_calls = max_calls
        self._left_bytes = max_bytes
        self._until_s = until_s
        self._stream = bytearray()

    @property
    def waiting_bytes(self) -> int:
        """Bytes that `take` has not returned."""
        return len(self._stream)

    def is_over(self, now: float) -> bool:
        """Return whether nothing more will be added."""
        return self.calls >= self._max_calls or now >= self._until_s or self._left_bytes <= 0

    def add(self, request: Any, reply: Any, failure: str | None, compute_ms: float, now: float) -> None:
        """Add one call to the service, unless the recording is over or the call is too large for it."""
        if self.is_over(now):
            return
        request, in_request = without_secrets(request)
        reply, in_reply = without_secrets(reply)
        call = RecordedCall(request, reply, failure, compute_ms, in_request + in_reply)
        body = msgspec.msgpack.encode(call, enc_hook=binary_encode_hook)
        if len(body) > self._left_bytes:
            self.left_out += 1
            return
        self._left_bytes -= len(body)
        self.calls += 1
        self._stream += _LENGTH.pack(len(body)) + body

    def take(self, max_bytes: int) -> bytes:
        """Return the next bytes of the stream, at most *max_bytes*, and forget them."""
        data = bytes(self._stream[:max_bytes])
        del self._stream[:max_bytes]
        return data


def recorded_calls(stream: bytes) -> Iterator[RecordedCall]:
    """Yield the calls of a stream; one that is cut off at its end is left out.

    Raises:
        BadMessage: It is no such stream.
    """
    decoder = msgspec.msgpack.Decoder(RecordedCall, ext_hook=extension_hook)
    at = 0
    while at + _LENGTH.size <= len(stream):
        (length,) = _LENGTH.unpack_from(stream, at)
        at += _LENGTH.size
        if at + length > len(stream):
            return
        try:
            yield decoder.decode(stream[at : at + length])
        except RsePfError:
            raise
        except (msgspec.DecodeError, ValueError, TypeError) as error:
            raise BadMessage(f"a recording that cannot be read: {error}") from error
        at += length


def without_secrets(value: Any) -> tuple[Any, int]:
    """Return *value* with every text replaced that looks like a secret, and how many these are.

    Secrets are JSON Web Tokens, what follows ``Bearer``, signatures of addresses, and texts under a name like
    ``token`` or ``password``.
    """
    if isinstance(value, str):
        return _text_without_secrets(value)
    if isinstance(value, bytes | bytearray | memoryview):
        data = bytes(value)
        if not any(hint.encode() in data for hint in _HINTS):
            return value, 0
        _, found = _text_without_secrets(data.decode("latin-1"))
        return (LEFT_OUT.encode(), found) if found else (value, 0)
    if isinstance(value, Mapping):
        made, count = {}, 0
        for key, each in value.items():
            is_secret = isinstance(key, str) and _SECRET_NAME.fullmatch(key) and isinstance(each, str | bytes)
            made[key], found = (LEFT_OUT, 1) if is_secret and each else without_secrets(each)
            count += found
        return made, count
    if isinstance(value, list | tuple):
        pairs = [without_secrets(each) for each in value]
        return [each for each, _ in pairs], sum(found for _, found in pairs)
    return value, 0


def _text_without_secrets(text: str) -> tuple[str, int]:
    if not any(hint in text for hint in _HINTS):
        return text, 0
    return _SECRET.subn(LEFT_OUT, text)
