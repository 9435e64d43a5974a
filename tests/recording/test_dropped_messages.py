"""What workers dropped stands in the recording, each message once."""

from __future__ import annotations

import struct
from typing import Any, cast

from rse_pf.extensions.recording.recorder_process import MessageRecorder, PipeRecorder
from rse_pf.extensions.recording.tap import _ENTRY, LOST


class Events:
    """Takes events as a recorder writes them."""

    def __init__(self) -> None:
        self.dropped: list[int] = []

    def event(self, time_ns: int, kind: str, **fields: Any) -> None:
        assert kind == "recording-dropped"
        self.dropped.append(fields["messages"])


def test_an_event_counts_what_was_dropped_since_the_last_one() -> None:
    events = Events()
    worker = PipeRecorder(cast(MessageRecorder, events))

    for total in (3, 10):  # a worker tells how many it has dropped since its start
        worker.read(_ENTRY.pack(LOST, 0, 1, 8) + struct.pack("<Q", total))

    assert events.dropped == [3, 7]
