"""The sha256 of uploads that grow, computed by a thread beside while the next part is on its way.

Only what this process stored itself, from the first byte on, has a hash here; the hash of everything else is
computed from what is stored.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

__all__ = ["RunningHashes"]

_MAX_UPLOADS = 256
"""Uploads whose hash is remembered; the one that grew least recently is forgotten first."""
_THREADS = 2


@dataclass(slots=True)
class _Running:
    hashed: Any = field(default_factory=hashlib.sha256)
    size: int = 0
    last: Future[None] | None = None


class RunningHashes:
    """Hashes by the name of the upload.  Used by several threads, for one upload by one at a time."""

    def __init__(self) -> None:
        """Know of no upload."""
        self._lock = threading.Lock()  # of the dictionary, never held during work
        self._known: OrderedDict[str, _Running] = OrderedDict()
        self._pool = ThreadPoolExecutor(_THREADS, "hash")

    def add(self, name: str, offset: int, data: bytes) -> None:
        """Go on with *data*, which begins at *offset*; waits until the part before it is done.

        So at most one part of each upload is in memory for its hash.
        """
        with self._lock:
            running = self._known.pop(name, None)
        if offset == 0:
            running = _Running()
        if running is None or running.size != offset:
            return
        if running.last is not None:
            running.last.result()
        running.last, running.size = self._pool.submit(running.hashed.update, data), offset + len(data)
        with self._lock:
            self._known[name] = running
            if len(self._known) > _MAX_UPLOADS:
                self._known.popitem(last=False)

    def take(self, name: str, size: int) -> str | None:
        """Return the digest of all *size* bytes in hex, and forget it; None if it is not known."""
        with self._lock:
            running = self._known.pop(name, None)
        if running is None or running.size != size or running.last is None:
            return None
        running.last.result()
        return str(running.hashed.hexdigest())

    def forget(self, name: str) -> None:
        """Forget an upload."""
        with self._lock:
            self._known.pop(name, None)
