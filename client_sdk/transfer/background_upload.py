"""Upload encoded keyframes as objects of the data service: in order, at a limited rate, from a spool folder.

This serves a robot that has no live map; a live map has its own queue in `client_sdk.live.keyframe_queue`.
The spool folder holds the keyframes that are not uploaded yet, has a bounded size, and survives a restart of
the robot.  The rate limit allows no burst: keyframes of hours without a network are uploaded at a steady
rate, so that they do not delay the robot's pose queries.
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
"""Default rate of uploads, in bytes per second: a small part of a wireless link, so that pose queries are not
delayed."""
MAX_SPOOL_BYTES = 1 << 30
"""Default limit of the spool folder, in bytes: space for the keyframes of some hours without a network."""
THREAD_JOIN_S = 5.0
"""How long `BackgroundUploader.close` waits for its thread to end, in seconds: the thread may be in the
middle of an upload, which ends soon because `close` has closed the connection."""
RETRY_PAUSE_S = 5.0
"""Pause before a failed upload is tried again, in seconds: an upload fails only after the data client has
repeated one request for `DataOptions.deadline_s`, so a short pause more makes no difference."""
BUSY_POLL_S = 0.05
"""Pause between two calls of *is_busy* while it returns True, in seconds."""


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
        """Store the arguments; `start` begins the uploads.

        Args:
            uploads: Client of the data service; `close` closes its connection.
            folder: The spool folder, which `start` creates; keyframes of an earlier run in it are uploaded,
                too.
            bytes_per_s: Highest rate of the uploads, in bytes per second.
            max_spool_bytes: Largest size of the spool folder; keyframes that do not fit are dropped.
            clock: Monotonic seconds.
            is_busy: Returns whether pose queries of the robot are waiting for answers; while it returns True,
                no keyframe and no part of a keyframe is sent.  If it raises, the exception is logged and the
                uploads go on.
        """
        self.sent = 0
        """Number of keyframes that this object has uploaded."""
        self.dropped = 0
        """Number of keyframes that are lost: the spool or the disk was full, or the data service refused the
        keyframe in a way that a second attempt would not change."""
        self.last_error = ""
        """Message of the last failed upload or write to the spool; empty before the first failure."""
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
        """Number of keyframes in the spool: those not uploaded yet."""
        with self._condition:
            return len(self._spooled)

    def add(self, data: bytes) -> str | None:
        """Write an encoded keyframe to the spool without waiting for its upload.

        Returns:
            The sha256 of *data*, which is the name of the object at the data service; None if the keyframe
            was dropped because the spool or the disk is full.
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
        """Wait until the spool is empty, at most *timeout_s* seconds; return whether it is empty.

        The spool becomes empty when each keyframe in it is uploaded or dropped (see `dropped`).
        """
        with self._condition:
            return self._condition.wait_for(lambda: not self._spooled, timeout_s)

    def close(self) -> None:
        """Close the connection of *uploads* and wait at most 5 s for the thread to end.

        An upload that runs fails because of the closed connection.  Keyframes that are not uploaded stay in
        the spool for the next run.
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
        """Upload the file *name* of the spool and remove it; return False if the upload has to be repeated.

        If a second attempt would fail in the same way, the file is removed and counts as dropped.
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
        """Wait until *is_busy* returns False; return False if the uploader was closed meanwhile."""
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
