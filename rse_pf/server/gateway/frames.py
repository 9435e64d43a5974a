"""Assemble WebSocket frames to messages by RFC 6455, and close a connection that violates it or a limit.

Frames and times go in, decisions come out (`Received`, `SendPong`, `CloseSocket`).  At most one incomplete
message is in memory, of at most ``session.max_message_bytes``.
"""

from __future__ import annotations

import msgspec

from rse_pf.config import SessionSettings
from rse_pf.limits.token_bucket import TokenBucket

__all__ = [
    "CLOSE_INVALID_TEXT",
    "CLOSE_NORMAL",
    "CLOSE_POLICY",
    "CLOSE_PROTOCOL_ERROR",
    "CLOSE_TOO_BIG",
    "CloseBorder",
    "CloseSocket",
    "FrameAssembler",
    "FrameDecision",
    "Received",
    "SendPong",
]

# Opcodes of frames: RFC 6455, 5.2.
CONTINUATION = 0
TEXT = 1
BINARY = 2
CLOSE = 8
PING = 9
PONG = 10

# Close codes: RFC 6455, 7.4.1.
CLOSE_NORMAL = 1000
CLOSE_PROTOCOL_ERROR = 1002
CLOSE_INVALID_TEXT = 1007
CLOSE_POLICY = 1008
CLOSE_TOO_BIG = 1009

# Pings and pongs of one socket a second, and as many at once: a robot sends one ping in two seconds.
MAX_CONTROL_PER_S = 10.0
_CONTROL = (CLOSE, PING, PONG)
_MAX_CONTROL = 125  # payload bytes of a control frame: RFC 6455, 5.5
# Close codes below 3000 that a close frame may carry; codes from 3000 to 4999 are free for applications.
_KNOWN_CLOSE_CODES = frozenset({1000, 1001, 1002, 1003, 1007, 1008, 1009, 1010, 1011, 1012, 1013, 1014})


class Received(msgspec.Struct, frozen=True, gc=False):
    """Decision: pass this whole message on; if it is text, it is valid UTF-8."""

    data: bytes
    is_text: bool


class SendPong(msgspec.Struct, frozen=True, gc=False):
    """Decision: answer a ping by a pong frame with this payload."""

    data: bytes


class CloseSocket(msgspec.Struct, frozen=True, gc=False):
    """Decision: send a CLOSE frame with this code and reason, then close the connection."""

    code: int
    reason: str = ""


FrameDecision = Received | SendPong | CloseSocket


class FrameAssembler:
    """Assembles the frames of one socket to messages; ignores all frames once it is ``closed``."""

    __slots__ = (
        "_control_frames",
        "_count",
        "_limits",
        "_message",
        "_opcode",
        "_size",
        "closed",
    )

    def __init__(self, limits: SessionSettings, *, max_control_per_s: float = MAX_CONTROL_PER_S) -> None:
        self.closed = False
        self._limits = limits
        self._message: list[bytes] | None = None
        self._opcode = 0
        self._count = 0
        self._size = 0
        self._control_frames = TokenBucket(max_control_per_s, max_control_per_s)

    def receive(self, opcode: int, fin: bool, rsv: bool, payload: bytes, now: float) -> FrameDecision | None:
        """Return the decision about one frame that arrived at *now* (s); None if nothing is to be done.

        That is after a pong, after a fragment that does not end its message, and once the socket is closed.

        Args:
            opcode: Kind of the frame: RFC 6455, 5.2.
            fin: Whether the frame ends its message.
            rsv: Whether a reserved bit is set, which closes the connection.
            payload: The unmasked payload.
            now: Seconds, monotonic; limits control frames to `MAX_CONTROL_PER_S`.
        """
        if self.closed:
            return None
        if rsv:
            return self._close(CLOSE_PROTOCOL_ERROR, "reserved bits are set")
        if opcode in (TEXT, BINARY):
            return self._begin(opcode, fin, payload)
        if opcode == CONTINUATION:
            return self._continue(fin, payload)
        if opcode not in _CONTROL or not fin or len(payload) > _MAX_CONTROL:
            return self._close(CLOSE_PROTOCOL_ERROR, "bad frame")
        if opcode == CLOSE:
            return self._answer_close(payload)
        if self._control_frames.take(now) > 0:
            return self._close(CLOSE_POLICY, "too many control frames")
        return SendPong(payload) if opcode == PING else None

    def _begin(self, opcode: int, fin: bool, payload: bytes) -> FrameDecision | None:
        """Handle the first frame of a message: pass it on if it is whole, or keep it for further frames."""
        if self._message is not None:
            return self._close(CLOSE_PROTOCOL_ERROR, "a message inside of a message")
        if len(payload) > self._limits.max_message_bytes:
            return self._close(CLOSE_TOO_BIG, "message too big")
        if fin:
            return self._finish(opcode, payload)
        self._message, self._opcode = [payload], opcode
        self._count, self._size = 1, len(payload)
        return None

    def _continue(self, fin: bool, payload: bytes) -> FrameDecision | None:
        """Add a continuation frame to the incomplete message; pass the message on if it is whole."""
        if self._message is None:
            return self._close(CLOSE_PROTOCOL_ERROR, "nothing to continue")
        self._count += 1
        self._size += len(payload)
        if self._count > self._limits.max_fragments:
            return self._close(CLOSE_TOO_BIG, "too many fragments")
        if self._size > self._limits.max_message_bytes:
            return self._close(CLOSE_TOO_BIG, "message too big")
        self._message.append(payload)
        if not fin:
            return None
        whole, self._message = b"".join(self._message), None
        return self._finish(self._opcode, whole)

    def _finish(self, opcode: int, data: bytes) -> FrameDecision:
        """Return the decision to pass a message on, or to close for text that is not valid UTF-8."""
        if opcode == BINARY:
            return Received(data, False)
        if not data.isascii():
            try:
                data.decode()
            except UnicodeDecodeError:
                return self._close(CLOSE_INVALID_TEXT, "text is not UTF-8")
        return Received(data, True)

    def _answer_close(self, payload: bytes) -> CloseSocket:
        """Return the decision to answer a CLOSE frame, by its own code if the frame is valid."""
        if not payload:
            return self._close(CLOSE_NORMAL, "")
        code = int.from_bytes(payload[:2], "big")
        if len(payload) == 1 or not (code in _KNOWN_CLOSE_CODES or 3000 <= code <= 4999):
            return self._close(CLOSE_PROTOCOL_ERROR, "bad close code")
        try:
            payload[2:].decode()
        except UnicodeDecodeError:
            return self._close(CLOSE_PROTOCOL_ERROR, "close reason is not UTF-8")
        return self._close(code, "")

    def _close(self, code: int, reason: str) -> CloseSocket:
        """Ignore all further frames, and return the decision to close the socket with *code*."""
        self.closed = True
        self._message = None
        return CloseSocket(code, reason)


class CloseBorder:
    """Find the end of the first CLOSE frame in the bytes of a socket, by the headers of its frames.

    Bytes behind a CLOSE frame must be ignored (RFC 6455, 5.5.1).  picows parses one frame ahead, and would
    answer invalid bytes behind the CLOSE frame before the CLOSE frame itself.

    ``shut`` is whether the CLOSE frame has ended, ``is_upgraded`` whether the request head has ended.
    """

    __slots__ = ("_head", "_is_close", "_left", "is_upgraded", "shut")

    def __init__(self, *, upgraded: bool = False) -> None:
        """Expect the request head of the handshake first, or frames if *upgraded*."""
        self.shut = False
        self.is_upgraded = upgraded
        self._head = b""  # bytes of a request head or of a frame header that has arrived in part
        self._left = 0  # payload bytes of the present frame that have not arrived
        self._is_close = False

    def bytes_to_close(self, data: memoryview, n: int) -> int:
        """Read the next bytes, the first *n* of *data*, and return how many are not behind a CLOSE frame.

        The count includes the CLOSE frame itself, and is 0 once that frame has ended.
        """
        if self.shut:
            return 0
        payload_left = self._left
        if payload_left:
            if n <= payload_left and not self._is_close:
                self._left = payload_left - n
                return n
        elif self.is_upgraded and not self._head and n >= 6 and not data[0] & 8:
            # Fast path for most reads: one whole masked data frame of less than 64 KiB.
            size = data[1] - 128
            if n == (8 + (data[2] << 8) + data[3] if size == 126 else 6 + size if size < 126 else 0):
                return n
        data = data[:n]
        start = 0 if self.is_upgraded else self._end_of_request(data)
        return n if start < 0 else self._walk(data, start)

    def _end_of_request(self, data: memoryview) -> int:
        """Return the index in *data* behind the request head, -1 if the head has not ended yet."""
        head = self._head + bytes(data)
        blank = head.find(b"\r\n\r\n")
        if blank < 0:
            self._head = head[-3:]
            return -1
        start = blank + 4 - len(self._head)
        self._head, self.is_upgraded = b"", True
        return start

    def _walk(self, data: memoryview, i: int) -> int:
        """Read the frames of *data* from index *i*; return the index behind a CLOSE frame, or the length."""
        n = len(data)
        while i < n:
            if self._left:
                step = min(self._left, n - i)
                self._left -= step
                i += step
            else:
                i = self._read_head(data, i)
            if self._is_close and not self._left and not self._head:
                self.shut = True
                return i
        return n

    def _read_head(self, data: memoryview, i: int) -> int:
        """Read the header of a frame at index *i* and return the index behind it, or behind all of *data*."""
        head = self._head + bytes(data[i : i + 14 - len(self._head)])
        length = _head_length(head)
        if length > len(head):
            self._head = head
            return len(data)
        used = length - len(self._head)
        self._head = b""
        self._left = _payload_length(head)
        self._is_close = head[0] & 15 == CLOSE
        return i + used


def _head_length(head: bytes | memoryview) -> int:
    """Return the length of the frame header that *head* begins, as far as its first two bytes are there."""
    if len(head) < 2:
        return 2
    size = head[1] & 127
    return 2 + (2 if size == 126 else 8 if size == 127 else 0) + (4 if head[1] & 128 else 0)


def _payload_length(head: bytes | memoryview) -> int:
    """Return the payload length that the whole frame header *head* states."""
    size = head[1] & 127
    if size == 126:
        return int.from_bytes(head[2:4], "big")
    return int.from_bytes(head[2:10], "big") if size == 127 else size
