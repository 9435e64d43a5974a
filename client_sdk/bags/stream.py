"""Fetch raw images of a bag by their time stamps; ascending stamps are read without seeking.

Messages that were read before they are wanted are kept, up to a total size of `_MAX_WAITING_BYTES`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence

from client_sdk.bags.bag_file import BagFile, BrokenMessage, RawMessage
from rse_pf.errors import UsageError

__all__ = ["ImageStream", "WantedImage"]

WantedImage = tuple[str, int, int]
"""An image of a bag: its topic, its time stamp, and the time at which it was written to the bag, both in
nanoseconds."""

_MAX_WAITING_BYTES = 64 * 1024 * 1024  # largest size of the messages that are kept for later calls
_MAX_READ_THROUGH_NS = 2_000_000_000
"""Longest gap in time, nanoseconds, over which the bag is read through; over longer gaps, seeking is
faster."""


class ImageStream:
    """Fetch images of the given topics from an open bag.

    With *use_log_time*, the time of writing takes the place of the time stamp in `WantedImage`.
    """

    def __init__(self, file: BagFile, topics: Sequence[str], *, use_log_time: bool) -> None:
        self._file = file
        self._topics = tuple(topics)
        self._use_log_time = use_log_time
        self._messages: Iterator[RawMessage] | None = None
        self._at_ns = 0
        self._waiting: OrderedDict[WantedImage, RawMessage] = OrderedDict()
        self._waiting_bytes = 0

    def take(self, wanted: Sequence[WantedImage]) -> list[RawMessage]:
        """Return the messages of the *wanted* images in their order.

        Kept messages up to the oldest time stamp of the *wanted* images are dropped.

        Raises:
            UsageError: The bag no longer holds one of the messages: it has changed.
        """
        missing = {image: image[2] for image in wanted}
        for key in list(missing):
            if key in self._waiting:
                del missing[key]
        if missing:
            start_ns = min(missing.values())
            if self._messages is None or not self._at_ns <= start_ns <= self._at_ns + _MAX_READ_THROUGH_NS:
                self._seek(start_ns)
            if not self._read(missing, until_ns=max(missing.values())):
                # Messages with one time, or of two files of a bag, may be in any order: search to the end.
                self._seek(start_ns)
                if not self._read(missing, until_ns=None):
                    raise UsageError(
                        f"{self._file.path} lacks messages that it held before",
                        hint="do not change a bag while it is read",
                    )
        taken = [self._waiting[image] for image in wanted]
        oldest = min(stamp for _, stamp, _ in wanted)
        for key in [key for key in self._waiting if key[1] <= oldest or key in wanted]:
            self._waiting_bytes -= len(self._waiting.pop(key).data)
        return taken

    def close(self) -> None:
        """Drop all kept messages."""
        self._messages = None
        self._waiting.clear()
        self._waiting_bytes = 0

    def _seek(self, start_ns: int) -> None:
        self._messages = self._file.messages(self._topics, start_ns=start_ns)
        self._at_ns = start_ns

    def _read(self, missing: dict[WantedImage, int], until_ns: int | None) -> bool:
        """Read messages until no image is *missing*, and return whether all of them were found.

        The result is False at the end of the bag, at damage, or after the first message that was written
        after *until_ns*.
        """
        assert self._messages is not None
        while missing:
            try:
                raw = next(self._messages, None)
            except BrokenMessage:
                raw = None
            if raw is None:
                return False
            self._store(raw, missing)
            if until_ns is not None and raw.log_ns > until_ns:
                break
        return not missing

    def _store(self, raw: RawMessage, missing: dict[WantedImage, int]) -> None:
        self._at_ns = max(self._at_ns, raw.log_ns)
        try:
            stamp_ns = raw.log_ns if self._use_log_time else self._file.stamp_ns(raw)
        except BrokenMessage:
            return
        key = (raw.topic, stamp_ns, raw.log_ns)
        if key in self._waiting:
            return
        self._waiting[key] = raw
        self._waiting_bytes += len(raw.data)
        missing.pop(key, None)
        while self._waiting_bytes > _MAX_WAITING_BYTES and len(self._waiting) > 2:
            _, dropped = self._waiting.popitem(last=False)
            self._waiting_bytes -= len(dropped.data)
