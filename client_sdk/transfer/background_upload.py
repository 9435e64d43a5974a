"""Upload keyframes in the background: at a limited rate, in order, from a bounded spool folder.

The rate limit allows no burst, so that keyframes collected during hours offline are uploaded at a steady rate
and do not delay live poses.  The spool survives a restart of the robot.  `BackgroundUploader.add` never
blocks; keyframes that do not fit into the spool are dropped and counted.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.transfer.data_client import DataClient
from rse_pf.errors import BadRequest, LimitExceeded, RsePfError, UsageError
from rse_pf.files import replace_file
from rse_pf.token_bucket import TokenBucket

__all__ = ["BYTES_PER_S", "MAX_SPOOL_BYTES", "BackgroundUploader"]

# Rate of the uploads: a small part of a wireless link, so that poses are not delayed.
BYTES_PER_S = 262_144.0
# Keyframes of some hours without a network.
MAX_SPOOL_BYTES = 1 << 30

_JOIN_TIMEOUT_S = 5.0
_RETRY_PAUSE_S = 5.0
_BUSY_POLL_S = 0.05


class BackgroundUploader:
    """Keep keyframes in a folder until a thread has uploaded them, oldest first."""

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
            folder: The spool; created by `start`, which also takes over keyframes of an earlier run.
            bytes_per_s: Rate of the uploads.
            max_spool_bytes: Size of the spool; keyframes above it are dropped.
            clock: Monotonic seconds.
            is_busy: Whether live poses are waiting; no keyframe and no part is started meanwhile.
                An exception counts as not busy, and is logged.
        """
        self.sent = 0
        self.dropped = 0
        self.last_error = ""
        self._uploads = uploads
        self._folder = folder
        self._bytes_per_s = bytes_per_s
        self._max_spool_bytes = max_spool_bytes
        self._clock = clock
        self._is_busy = is_busy
        self._callbacks = Callbacks()
        self._condition = threading.Condition()
        self._held: dict[str, int] = {}
        self._next = 0
        self._over = False
        self._thread = threading.Thread(target=self._work, name="keyframe-uploads", daemon=True)

    def start(self) -> None:
        """Take over the keyframes of an earlier run, and start the uploads."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._condition:
            for path in sorted(self._folder.glob("*.keyframe")):
                self._held[path.name] = path.stat().st_size
                self._next = max(self._next, int(path.name.partition("-")[0]) + 1)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """How many keyframes are not uploaded yet."""
        with self._condition:
            return len(self._held)

    def add(self, data: bytes) -> str | None:
        """Spool a keyframe and return its digest; None if the spool is full and it was dropped."""
        digest = hashlib.sha256(data).hexdigest()
        with self._condition:
            if sum(self._held.values()) + len(data) > self._max_spool_bytes:
                self.dropped += 1
                return None
            name = f"{self._next:012d}-{digest[:16]}.keyframe"
            self._next += 1
            try:
                replace_file(self._folder / name, data)
            except OSError as error:
                self.dropped += 1
                self.last_error = str(error)
                return None
            self._held[name] = len(data)
            self._condition.notify_all()
        return digest

    def wait_sent(self, timeout_s: float) -> bool:
        """Wait until all keyframes are uploaded; return whether they are."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._held, timeout_s)

    def close(self) -> None:
        """End the thread; keyframes not uploaded stay in the spool for the next run."""
        with self._condition:
            self._over = True
            self._condition.notify_all()
        self._uploads.close()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_JOIN_TIMEOUT_S)

    def _work(self) -> None:
        bucket = TokenBucket(self._bytes_per_s, burst=0.0)
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._over or bool(self._held))
                if self._over:
                    return
                name = min(self._held)
                size = self._held[name]
            if self._pause(bucket.spend(size, self._clock())) or not self._wait_for_quiet():
                return
            if not self._send(name) and self._pause(_RETRY_PAUSE_S):
                return

    def _send(self, name: str) -> bool:
        path = self._folder / name
        try:
            self._uploads.upload(path, self._between_parts)
        except (BadRequest, LimitExceeded, UsageError) as error:  # it is refused for good, or is missing
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
            self._held.pop(name, None)
            self._condition.notify_all()
        return True

    def _between_parts(self, done: int, size: int) -> None:
        if done < size:
            self._wait_for_quiet()

    def _wait_for_quiet(self) -> bool:
        while self._callbacks.call("is_busy", self._is_busy, default=False):
            if self._pause(_BUSY_POLL_S):
                return False
        return True

    def _pause(self, seconds: float) -> bool:
        """Wait, and return whether the uploader was closed."""
        with self._condition:
            return self._condition.wait_for(lambda: self._over, seconds) if seconds > 0 else self._over
