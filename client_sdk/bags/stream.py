"""Raw images of a bag by their time stamps: in order without seeking, in any other order by seeking.

At most `_MAX_WAITING_BYTES` of messages wait for their turn.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence

from client_sdk.bags.bag_file import BagFile, BrokenMessage, RawMessage
from rse_pf.errors import UsageError

__all__ = ["ImageStream", "WantedImage"]

WantedImage = tuple[str, int, int]
"""Topic, stamp of the message and time of writing, nanoseconds."""

_MAX_WAITING_BYTES = 64 * 1024 * 1024
_SKIP_NS = 2_000_000_000
"""A gap over which seeking is faster than reading on."""


class ImageStream:
    """Read the wanted messages of some topics of an open bag."""

    def __init__(self, file: BagFile, topics: Sequence[str], *, use_log_time: bool) -> None:
        self._file = file
        self._topics = tuple(topics)
        self._use_log_time = use_log_time
        self._messages: Iterator[RawMessage] | None = None
        self._at_ns = 0
        self._waiting: OrderedDict[WantedImage, RawMessage] = OrderedDict()
        self._waiting_bytes = 0

    def take(self, wanted: Sequence[WantedImage]) -> list[RawMessage]:
        """Return these messages; earlier ones are forgotten.

        Raises:
            UsageError: The bag does not hold them any more.
        """
        missing = {image: image[2] for image in wanted}
        for key in list(missing):
            if key in self._waiting:
                del missing[key]
        if missing:
            start_ns = min(missing.values())
            if self._messages is None or not self._at_ns <= start_ns <= self._at_ns + _SKIP_NS:
                self._seek(start_ns)
            if not self._read(missing, until_ns=max(missing.values())):
                # Two messages of one time, or two files of one bag, may stand in any order: look again.
                self._seek(start_ns)
                if not self._read(missing, until_ns=None):
                    raise UsageError(
                        f"{self._file.path} does not hold its messages any more", hint="read it again"
                    )
        taken = [self._waiting[image] for image in wanted]
        oldest = min(stamp for _, stamp, _ in wanted)
        for key in [key for key in self._waiting if key[1] <= oldest or key in wanted]:
            self._waiting_bytes -= len(self._waiting.pop(key).data)
        return taken

    def close(self) -> None:
        """Forget all messages."""
        self._messages = None
        self._waiting.clear()
        self._waiting_bytes = 0

    def _seek(self, start_ns: int) -> None:
        self._messages = self._file.messages(self._topics, start_ns=start_ns)
        self._at_ns = start_ns

    def _read(self, missing: dict[WantedImage, int], until_ns: int | None) -> bool:
        """Read on until no message is missing; return False at the end of the bag, or of that time."""
        assert self._messages is not None
        while missing:
            try:
                raw = next(self._messages, None)
            except BrokenMessage:
                raw = None
            if raw is None:
                return False
            self._keep(raw, missing)
            if until_ns is not None and raw.log_ns > until_ns:
                break
        return not missing

    def _keep(self, raw: RawMessage, missing: dict[WantedImage, int]) -> None:
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
