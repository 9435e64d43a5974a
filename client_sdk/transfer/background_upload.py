"""Upload keyframes beside live poses: slowly, in order, from a bounded folder that outlives the robot.

A token bucket holds the pace, and it holds no more than one keyframe's worth of credit, so hours offline
end in a steady trickle and not in a burst ahead of live poses.  Promises never to block who adds, and to
count what was dropped when the folder was full.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from rse_pf.config import DataSettings
from rse_pf.errors import BadRequest, LimitExceeded, RsePfError, UsageError
from rse_pf.files import replace_file

__all__ = ["BackgroundUploader", "UploadRate"]

_LEFT_S = 5.0
_TRY_AGAIN_S = 5.0


class Uploads(Protocol):
    """What sends one object; `client_sdk.transfer.data_client.DataClient` does."""

    def upload(self, source: Path, progress: Callable[[int, int], None] | None = None) -> str:
        """Store a file and return its digest; tell bytes done and in all after each part."""

    def close(self) -> None:
        """Close the connection."""


class UploadRate:
    """A token bucket: ``bytes_per_s`` on average, and no credit is saved up while nothing is sent."""

    def __init__(self, bytes_per_s: float, now: float) -> None:
        self._rate = bytes_per_s
        self._free_at = now

    def wait_s(self, size: int, now: float) -> float:
        """Return how long to wait before *size* bytes may go, and count them as gone after that."""
        start = max(self._free_at, now)
        self._free_at = start + size / self._rate
        return start - now


class BackgroundUploader:
    """Keeps keyframes in *folder* until the data service has them; a thread sends them, oldest first."""

    def __init__(
        self,
        uploads: Uploads,
        folder: Path,
        settings: DataSettings,
        *,
        clock: Callable[[], float] = time.monotonic,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        """Remember what to do; `start` begins.

        Args:
            uploads: Where to.
            folder: The spool; made by `start`, and read first if it holds keyframes of an earlier run.
            settings: ``background_bytes_per_s``, ``max_spool_bytes``.
            clock: Monotonic seconds.
            is_busy: Says that live poses wait for the link; no keyframe and no part is begun while they do.
        """
        self.sent = 0
        self.dropped = 0
        self.last_error = ""
        self._uploads = uploads
        self._folder = folder
        self._settings = settings
        self._clock = clock
        self._is_busy = is_busy
        self._condition = threading.Condition()
        self._held: dict[str, int] = {}
        self._next = 0
        self._over = False
        self._thread = threading.Thread(target=self._work, name="keyframe-uploads", daemon=True)

    def start(self) -> None:
        """Pick up what an earlier run left, and begin to send."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._condition:
            for path in sorted(self._folder.glob("*.keyframe")):
                self._held[path.name] = path.stat().st_size
                self._next = max(self._next, int(path.name.partition("-")[0]) + 1)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """How many keyframes are not sent yet."""
        with self._condition:
            return len(self._held)

    @property
    def held_bytes(self) -> int:
        """How much of ``max_spool_bytes`` is in use."""
        with self._condition:
            return sum(self._held.values())

    def add(self, data: bytes) -> str | None:
        """Keep a keyframe for sending and return its digest; None if there is no room and it was dropped."""
        digest = hashlib.sha256(data).hexdigest()
        with self._condition:
            if sum(self._held.values()) + len(data) > self._settings.max_spool_bytes:
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
        """Wait until everything was sent; return whether it was."""
        with self._condition:
            return self._condition.wait_for(lambda: not self._held, timeout_s)

    def close(self) -> None:
        """End the thread; what is not sent stays in the folder for the next run."""
        with self._condition:
            self._over = True
            self._condition.notify_all()
        self._uploads.close()
        if self._thread.is_alive():
            self._thread.join(_LEFT_S)

    def _work(self) -> None:
        pace = UploadRate(self._settings.background_bytes_per_s, self._clock())
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._over or bool(self._held))
                if self._over:
                    return
                name = min(self._held)
                size = self._held[name]
            if self._pause(pace.wait_s(size, self._clock())) or not self._wait_for_quiet():
                return
            if not self._send(name) and self._pause(_TRY_AGAIN_S):
                return

    def _send(self, name: str) -> bool:
        path = self._folder / name
        try:
            self._uploads.upload(path, self._between_parts)
        except (BadRequest, LimitExceeded, UsageError) as error:  # it will never be taken, or is gone
            self.dropped += 1
            self.last_error = str(error)
        except RsePfError as error:
            self.last_error = str(error)
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
        while self._is_busy():
            if self._pause(0.05):
                return False
        return True

    def _pause(self, seconds: float) -> bool:
        """Wait, and say whether the work is over."""
        with self._condition:
            return self._condition.wait_for(lambda: self._over, seconds) if seconds > 0 else self._over
