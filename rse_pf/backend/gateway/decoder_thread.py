"""Read long messages in a thread of their own, so that a bomb costs its sender's time and nobody else's.

The event loop reads what is short: the commands of robots that solve poses.  What is long, or inflates to
much, waits here, robots that sent garbage before behind all others.  Promises that messages of one robot keep
their order (`Connection` takes nothing more from a robot whose message is here), to hold a bounded number
of bytes, and that each message is handed back exactly once, in the event loop.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable

from rse_pf.config import ServingSettings
from rse_pf.errors import Busy, ProtocolError
from rse_pf.wire import Codec, Failure
from rse_pf.wire.envelope import encode_refusal, peek
from rse_pf.wire.messages import FromRobot

__all__ = ["DecoderThread", "refusal_unread"]

_INFLATED = 4
"""What is read in the event loop may inflate so often; JSON of numbers does so two or three times."""
_SHARE_OF_SUSPECTS = 0.25
"""Of the bytes that may wait, for robots that sent garbage before."""
_RETRY_AFTER_MS = 500.0

Done = Callable[[FromRobot | ProtocolError], None]


class DecoderThread:
    """The thread of one worker that reads long messages."""

    def __init__(self, serving: ServingSettings, *, call_soon_threadsafe: Callable[..., object]) -> None:
        self.short_bytes = serving.inline_bytes
        """A message up to this size, on the wire, is tried in the event loop."""
        self.short_inflated_bytes = _INFLATED * serving.inline_bytes
        self._max_bytes = serving.max_unread_bytes
        self._call = call_soon_threadsafe
        self._bytes = 0
        self._count = 0
        self._waiting: list[tuple[int, int, Codec, bytes, Done]] = []
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread: threading.Thread | None = None

    def begin(self, codec: Codec, data: bytes, *, suspicion: int, done: Done) -> bool:
        """Read *data* and call *done* in the event loop; False if too much waits already.

        Args:
            codec: Of the robot.
            data: One whole message.
            suspicion: How many messages of the robot could not be read; who has fewer is read first.
            done: Takes the message, or why it is none.
        """
        most = self._max_bytes * (_SHARE_OF_SUSPECTS if suspicion else 1.0)
        with self._changed:
            if self._bytes and self._bytes + len(data) > most:
                return False
            self._bytes += len(data)
            self._count += 1
            heapq.heappush(self._waiting, (suspicion, self._count, codec, data, done))
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="reader", daemon=True)
            self._thread.start()
        return True

    def close(self) -> None:
        """Read nothing more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._is_closed:
                    self._changed.wait()
                if self._is_closed:
                    return
                _, _, codec, data, done = heapq.heappop(self._waiting)
            read: FromRobot | ProtocolError
            try:
                read = codec.decode_from_robot(data)
            except ProtocolError as error:
                read = error
            with self._changed:
                self._bytes -= len(data)
            self._call(done, read)


def refusal_unread(codec: Codec, data: bytes, server: str) -> bytes:
    """Return the answer to a long message for which there is no room."""
    envelope = peek(codec, data)
    failure = Failure(
        id=None if envelope is None else envelope.id, code=Busy.code, server=server,
        message="too many long messages wait to be read", hint="try again later, or send less at once",
        retry_after_ms=_RETRY_AFTER_MS,
    )  # fmt: skip
    return encode_refusal(codec, failure)
