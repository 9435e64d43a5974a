"""Decode long messages in a thread of their own, so that a decompression bomb delays only its sender.

The event loop decodes short messages, such as commands for poses.  A message that is long, or inflates to
more than `_MAX_INLINE_RATIO` times `INLINE_BYTES`, waits here.  Messages of robots that sent undecodable
messages before are decoded last.  The messages of one robot keep their order, because `RobotConnection`
defers what arrives while one of its messages is decoded here.
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

# A message that is decoded in the event loop may inflate to this many times `INLINE_BYTES`; numbers in JSON
# inflate to two or three times their compressed size.
_MAX_INLINE_RATIO = 4

Done = Callable[[FromRobot | ProtocolError], None]


class DecoderThread:
    """The decoder thread of one worker; it starts with the first long message."""

    def __init__(
        self,
        call_soon_threadsafe: Callable[..., object],
        crash: CrashMarks,
        on_defect: Callable[[Exception], None],
    ) -> None:
        """Decode nothing yet.

        Args:
            call_soon_threadsafe: Calls a function in the event loop.
            crash: Notes whose message is decoded.
            on_defect: Takes, in the event loop, an exception that a codec should not raise.
        """
        self.short_bytes = INLINE_BYTES
        """A message up to this size, on the wire, is tried in the event loop."""
        self.short_inflated_bytes = _MAX_INLINE_RATIO * INLINE_BYTES
        self.unread_bytes = 0
        """Length of the messages that wait or are being decoded."""
        self._call = call_soon_threadsafe
        self._crash = crash
        self._on_defect = on_defect
        self._count = 0
        self._waiting: list[tuple[int, int, int, Codec, bytes, Done]] = []
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread: threading.Thread | None = None

    def begin(self, codec: Codec, data: bytes, *, number: int, suspicion: int, done: Done) -> None:
        """Decode *data* and call *done* once, in the event loop.

        Args:
            codec: The codec of the robot.
            data: One whole message, which `Admission.may_wait` admitted.
            number: Number of the connection.
            suspicion: `ServerSession.suspicion` of the robot; messages with a smaller one are decoded first.
            done: Gets the message, or the error of decoding it.
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
        """Decode nothing more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def _work(self) -> None:
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
