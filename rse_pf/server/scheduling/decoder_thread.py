"""Decode long messages of robots in a thread, so that a decompression bomb does not stop the event loop.

1. The event loop decodes a message of at most `INLINE_BYTES`, such as a command for a pose, unless it
   inflates to more than `_MAX_INLINE_RATIO` times `INLINE_BYTES`.
2. Every other message waits here.  Messages of robots that sent undecodable messages before are decoded last;
   otherwise messages are decoded in the order of their arrival.
3. While a message of a robot waits or is decoded, `RobotConnection` defers the robot's further messages, so
   that the messages of one robot keep their order.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable

from rse_pf.errors import BadMessage, ProtocolError
from rse_pf.server.scheduling.scheduler import INLINE_BYTES
from rse_pf.server.worker_context import CrashMarks
from rse_pf.wire import Codec
from rse_pf.wire.messages import FromRobot

__all__ = ["DecoderThread"]

# A message that the event loop decodes may inflate to at most this many times `INLINE_BYTES`: numbers in JSON
# inflate to two or three times their compressed size.
_MAX_INLINE_RATIO = 4

Done = Callable[[FromRobot | ProtocolError], None]
"""Gets a decoded message, or the error of decoding it."""


class DecoderThread:
    """The decoder thread of one worker, and the messages that wait for it; starts with the first message."""

    def __init__(
        self,
        call_soon_threadsafe: Callable[..., object],
        crash: CrashMarks,
        on_defect: Callable[[Exception], None],
    ) -> None:
        """Decode nothing yet.

        Args:
            call_soon_threadsafe: Method of the event loop, which calls a function in its thread.
            crash: Marks for which connection the thread works, in case the decoder crashes.
            on_defect: Called in the event loop with an exception that a codec should not raise.
        """
        self.short_bytes = INLINE_BYTES
        """Bytes on the wire up to which the event loop tries to decode a message."""
        self.short_inflated_bytes = _MAX_INLINE_RATIO * INLINE_BYTES
        """Bytes after inflating up to which the event loop decodes such a message."""
        self.unread_bytes = 0
        """Bytes on the wire of all messages that wait for the thread or are being decoded."""
        self._call = call_soon_threadsafe
        self._crash = crash
        self._on_defect = on_defect
        self._count = 0
        self._waiting: list[tuple[int, int, int, Codec, bytes, Done]] = []
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread: threading.Thread | None = None

    def begin(self, codec: Codec, data: bytes, *, number: int, suspicion: int, done: Done) -> None:
        """Let the thread decode *data*; return at once, and call *done* once in the event loop afterwards.

        Args:
            codec: The codec of the robot's connection.
            data: One whole message, which `Admission.may_wait` admitted.
            number: Number of the connection, for crash reports.
            suspicion: How many bad messages the robot sent (`ServerSession.suspicion`); of the messages that
                wait, the one with the smallest number is decoded first.
            done: Gets the decoded message, or the error of decoding it.
        """
        with self._changed:
            self.unread_bytes += len(data)
            self._count += 1
            heapq.heappush(self._waiting, (suspicion, self._count, number, codec, data, done))
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="decoder", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop the thread after the present message; messages that wait are not decoded."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def _work(self) -> None:
        """Decode the messages that wait, in the decoder thread, until `close`."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                _, _, number, codec, data, done = heapq.heappop(self._waiting)
            message: FromRobot | ProtocolError
            self._crash.compute_for(number)
            try:
                message = codec.decode_from_robot(data)
            except ProtocolError as error:
                message = error
            except Exception as error:  # noqa: BLE001  the messages of other robots are decoded after it
                message = BadMessage("the message cannot be decoded", hint="compare it with docs/protocol.md")
                self._call(self._on_defect, error)
            finally:
                self._crash.compute_for(0)
            with self._changed:
                self.unread_bytes -= len(data)
            self._call(done, message)
