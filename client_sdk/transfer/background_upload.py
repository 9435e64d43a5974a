"""Upload keyframes in the background: in order, at a limited rate, from a spool folder of bounded size.

The rate limit allows no burst: keyframes of hours without a network are uploaded at a steady rate, so that
they do not delay live poses.  The spool survives a restart of the robot.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.transfer.data_client import DataClient
from rse_pf.errors import BadRequest, LimitExceeded, RsePfError, UsageError
from rse_pf.files import replace_file
from rse_pf.token_bucket import TokenBucket

__all__ = ["BYTES_PER_S", "MAX_SPOOL_BYTES", "BackgroundUploader"]

BYTES_PER_S = 262_144.0
"""Default rate of uploads, in bytes per second: a small part of a wireless link, so that poses are not
delayed."""
MAX_SPOOL_BYTES = 1 << 30
"""Default limit of the spool folder, in bytes: space for the keyframes of some hours without a network."""
THREAD_JOIN_S = 5.0
"""How long `BackgroundUploader.close` waits for the upload that its thread works on, in seconds."""
RETRY_PAUSE_S = 5.0
"""Pause in seconds before a failed upload is tried again; the data client has repeated each request
before."""
BUSY_POLL_S = 0.05
"""Pause between two calls of *is_busy* while live poses are waiting, in seconds."""


class BackgroundUploader:
    """Keep keyframes in a spool folder until a thread has uploaded them, oldest first."""

    def __init__(
        self,
        uploads: DataClient,
        folder: Path,
        *,
        bytes_per_s: float = BYTES_PER_S,
        max_spool_bytes: int = MAX_SPOOL_BYTES,
        clock: Callable[[], float] = time.monotonic,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        """Describe the uploads; `start` begins them.

        Args:
            uploads: Client of the data service.
            folder: The spool folder, which `start` creates; keyframes of an earlier run in it are uploaded,
                too.
            bytes_per_s: Highest rate of the uploads, in bytes per second.
            max_spool_bytes: Largest size of the spool folder; keyframes that do not fit are dropped.
            clock: Monotonic seconds.
            is_busy: Returns whether live poses are waiting; no keyframe and no part of one is sent meanwhile.
                If it raises, the exception is logged and the uploads go on.
        """
        self.sent = 0
        """Keyframes that were uploaded."""
        self.dropped = 0
        """Keyframes that did not fit into the spool, or that the data service refused for good."""
        self.last_error = ""
        """Message of the last failure, empty without one."""
        self._uploads = uploads
        self._folder = folder
        self._bytes_per_s = bytes_per_s
        self._max_spool_bytes = max_spool_bytes
        self._clock = clock
        self._is_busy = is_busy
        self._callbacks = UserCallbacks()
        self._condition = threading.Condition()
        self._spooled: dict[str, int] = {}
        self._next_number = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._run_uploads, name="keyframe-uploads", daemon=True)

    def start(self) -> None:
        """Find the keyframes of an earlier run in the spool folder, and start the thread of the uploads."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._condition:
            for path in sorted(self._folder.glob("*.keyframe")):
                self._spooled[path.name] = path.stat().st_size
                self._next_number = max(self._next_number, int(path.name.partition("-")[0]) + 1)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of keyframes that are not uploaded yet."""
        with self._condition:
            return len(self._spooled)

    def add(self, data: bytes) -> str | None:
        """Write an encoded keyframe to the spool without waiting for its upload.

        Returns:
            The sha256 of the keyframe; None if it was dropped because the spool or the disk is full.
        """
        digest = hashlib.sha256(data).hexdigest()
        with self._condition:
            if sum(self._spooled.values()) + len(data) > self._max_spool_bytes:
                self.dropped += 1
                return None
            name = f"{self._next_number:012d}-{digest[:16]}.keyframe"
            self._next_number += 1
            try:
                replace_file(self._folder / name, data)
            except OSError as error:
                self.dropped += 1
                self.last_error = str(error)
                return None
            self._spooled[name] = len(data)
            self._condition.notify_all()
        return digest

    def wait_sent(self, timeout_s: float) -> bool:
        """Wait until each keyframe is uploaded or refused for good, at most *timeout_s* seconds.

        Return whether none is left.
        """
        with self._condition:
            return self._condition.wait_for(lambda: not self._spooled, timeout_s)

    def close(self) -> None:
        """End the thread and close the connection of *uploads*; an upload that runs has at most 5 s to end.

        Keyframes that are not uploaded stay in the spool for the next run.
        """
        with self._condition:
            self._is_closed = True
            self._condition.notify_all()
        self._uploads.close()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(THREAD_JOIN_S)

    def _run_uploads(self) -> None:
        bucket = TokenBucket(self._bytes_per_s, burst=0.0)
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._is_closed or bool(self._spooled))
                if self._is_closed:
                    return
                name = min(self._spooled)
                size = self._spooled[name]
            if self._wait_closed(bucket.spend(size, self._clock())) or not self._wait_not_busy():
                return
            if not self._upload(name) and self._wait_closed(RETRY_PAUSE_S):
                return

    def _upload(self, name: str) -> bool:
        """Upload a file of the spool and remove it; return False if it has to be tried again.

        A file that is refused for good is removed, and counts as dropped.
        """
        path = self._folder / name
        try:
            self._uploads.upload(path, self._pause_between_parts)
        except (
            BadRequest,
            LimitExceeded,
            UsageError,
        ) as error:  # a second attempt would fail in the same way
            self.dropped += 1
            self.last_error = error.message
        except RsePfError as error:
            self.last_error = error.message
            return False
        else:
            self.sent += 1
        with contextlib.suppress(OSError):
            path.unlink()
        with self._condition:
            self._spooled.pop(name, None)
            self._condition.notify_all()
        return True

    def _pause_between_parts(self, done: int, size: int) -> None:
        if done < size:
            self._wait_not_busy()

    def _wait_not_busy(self) -> bool:
        """Wait until no live pose is waiting; return False if the uploader was closed."""
        while self._callbacks.call("is_busy", self._is_busy, default=False):
            if self._wait_closed(BUSY_POLL_S):
                return False
        return True

    def _wait_closed(self, seconds: float) -> bool:
        """Wait until the uploader is closed, at most for *seconds*; return whether it is."""
        with self._condition:
            if seconds > 0:
                self._condition.wait_for(lambda: self._is_closed, seconds)
            return self._is_closed
