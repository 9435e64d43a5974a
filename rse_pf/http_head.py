"""Read the head of an HTTP/1.1 request, and the frame of its body, more strictly than the RFC asks.

Whatever two readers might understand differently is refused: a second length, a folded line, a bare line
feed, a control letter, a chunk extension.  Nothing is accepted that `h11` refuses, or understands
differently; `fuzz.http_twin` compares the two on mutated requests.  Nothing is sent or received here.

Source:
    RFC 9112, sections 2.2, 3, 5, 6 and 7.1; RFC 9110, section 5.5.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

__all__ = ["MAX_HEADERS", "MAX_HEAD_BYTES", "BadRequestBytes", "ChunkedBody", "RequestHead", "parse_head"]

MAX_HEAD_BYTES = 16384
"""Of a request, with the empty line that ends it."""
MAX_HEADERS = 64
_HEAD = re.compile(
    rb"([A-Z]{1,16}) (/[!-~]*) HTTP/1\.1\r\n"
    rb"((?:[-!#$%&'*+.^_`|~0-9A-Za-z]+:[\t -~\x80-\xff]*\r\n){1," + b"%d" % MAX_HEADERS + rb"})\r\n"
)
_LENGTH = re.compile(rb"[0-9]{1,18}")
_CHUNK = re.compile(rb"([0-9A-Fa-f]{1,15})\r\n")
_LONGEST_CHUNK_LINE = 17
_HOST, _SIZE, _CODING = b"host", b"content-length", b"transfer-encoding"
_CONNECTION, _EXPECT = b"connection", b"expect"


class BadRequestBytes(ValueError):
    """What was received is no request that has one meaning only."""


@dataclass(frozen=True, slots=True)
class RequestHead:
    """A request without its body.

    Attributes:
        method: Upper-case letters.
        target: From the first slash on, with the query; visible ASCII.
        headers: Lower-case names and values, in their order.
        body_bytes: Length of the body; None if it comes in chunks.
        closes: Whether the client wants the connection closed after the reply.
        expects_continue: Whether the client sends its body only when it is told to.
    """

    method: bytes
    target: bytes
    headers: list[tuple[bytes, bytes]]
    body_bytes: int | None
    closes: bool
    expects_continue: bool


def parse_head(head: bytes) -> RequestHead:
    """Return the request whose head, with the empty line that ends it, is *head*; raises BadRequestBytes."""
    match = _HEAD.fullmatch(head) if len(head) <= MAX_HEAD_BYTES else None
    if match is None:
        raise BadRequestBytes("no head of a request")
    headers: list[tuple[bytes, bytes]] = []
    singles: dict[bytes, bytes] = {}
    closes = expects_continue = False
    for line in match[3].split(b"\r\n")[:-1]:
        name, _, value = line.partition(b":")
        name, value = name.lower(), value.strip(b" \t")
        value = value.lower() if name == _CODING else value
        headers.append((name, value))
        if name in (_HOST, _SIZE, _CODING):
            if name in singles:
                raise BadRequestBytes("a header that may be there once is there twice")
            singles[name] = value
        elif name == _CONNECTION:
            closes = closes or b"close" in (option.strip(b" \t") for option in value.lower().split(b","))
        elif name == _EXPECT:
            expects_continue = value.lower() == b"100-continue"
    if _HOST not in singles:
        raise BadRequestBytes("no host")
    body_bytes = _body_bytes(singles.get(_SIZE), singles.get(_CODING))
    return RequestHead(match[1], match[2], headers, body_bytes, closes, expects_continue and body_bytes != 0)


def _body_bytes(size: bytes | None, coding: bytes | None) -> int | None:
    if coding is not None:
        if size is not None or coding != b"chunked":
            raise BadRequestBytes("a body with two lengths, or of an unknown coding")
        return None
    if size is None:
        return 0
    if not _LENGTH.fullmatch(size):
        raise BadRequestBytes("a length that is no number")
    return int(size)


class ChunkedBody:
    """Decodes a body that comes in chunks; extensions and trailers are refused."""

    def __init__(self) -> None:
        """Begin before the first chunk."""
        self._buffer = b""
        self._left = 0
        """Bytes of the present chunk that are to come, and 2 for the end of its line."""
        self._last = False

    def decode(self, data: bytes) -> tuple[list[bytes], bytes | None]:
        """Return pieces of the body in *data*, and what follows after the body; None before its end.

        Raises:
            BadRequestBytes: *data* does not continue the body.
        """
        pieces: list[bytes] = []
        data, self._buffer = self._buffer + data, b""
        at, end = 0, len(data)
        while at < end:
            if self._left > 2:
                piece = data[at : at + self._left - 2]
                pieces.append(piece)
                at, self._left = at + len(piece), self._left - len(piece)
            elif self._left:
                if not b"\r\n".startswith(data[at : at + 2]):
                    raise BadRequestBytes("a chunk is longer than its size")
                if end - at < 2:
                    break
                at, self._left = at + 2, 0
                if self._last:
                    return pieces, data[at:]
            else:
                match = _CHUNK.match(data, at)
                if match is None:
                    self._check_begun(data[at:])
                    break
                at = match.end()
                size = int(match[1], 16)
                self._left, self._last = size + 2, not size
        self._buffer = data[at:]
        return pieces, None

    def _check_begun(self, line: bytes) -> None:
        """Raise BadRequestBytes unless *line* begins the line of a chunk's size."""
        if len(line) >= _LONGEST_CHUNK_LINE or not re.fullmatch(rb"[0-9A-Fa-f]+\r?", line):
            raise BadRequestBytes("no size of a chunk")
