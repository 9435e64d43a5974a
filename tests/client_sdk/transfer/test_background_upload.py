"""Uploads of keyframes in the background: rate limit, order, spool, and yielding to live poses."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from client_sdk.transfer.background_upload import BackgroundUploader
from rse_pf.errors import BadRequest
from rse_pf.token_bucket import TokenBucket


def test_the_rate_limit_of_uploads_allows_no_burst_after_an_idle_time() -> None:
    bucket = TokenBucket(1000.0, burst=0.0)

    waits = [bucket.spend(500, now) for now in (3600.0, 3600.0, 3600.0)]

    assert waits == [0.0, 0.5, 1.0]


class FakeUploads:
    """Accept uploads, or fail as the test demands; note the time of each."""

    def __init__(self) -> None:
        self.taken: list[bytes] = []
        self.errors: list[Exception] = []
        self.parts: queue.SimpleQueue[int] = queue.SimpleQueue()

    def upload(self, source: Path, progress: Callable[[int, int], None]) -> str:
        if self.errors:
            raise self.errors.pop(0)
        data = source.read_bytes()
        for done in (0, len(data) // 2, len(data)):
            self.parts.put(done)
            progress(done, len(data))
        self.taken.append(data)
        return ""

    def close(self) -> None:
        """Do nothing: the fake client has no connection."""


@contextmanager
def started(uploads: FakeUploads, folder: Path, **more: object) -> Iterator[BackgroundUploader]:
    uploader = BackgroundUploader(uploads, folder, bytes_per_s=1e8, max_spool_bytes=4000, **more)  # type: ignore[arg-type]
    uploader.start()
    try:
        yield uploader
    finally:
        uploader.close()


def test_keyframes_are_uploaded_in_order_and_removed_from_the_spool(tmp_path: Path) -> None:
    uploads = FakeUploads()
    with started(uploads, tmp_path / "spool") as uploader:
        for n in range(5):
            assert uploader.add(bytes([n]) * 100)

        assert uploader.wait_sent(20)

    assert uploads.taken == [bytes([n]) * 100 for n in range(5)]
    assert list((tmp_path / "spool").iterdir()) == []
    assert uploader.sent == 5


def test_the_spool_is_bounded_and_dropped_keyframes_are_counted(tmp_path: Path) -> None:
    with started(FakeUploads(), tmp_path / "spool", is_busy=lambda: True) as uploader:
        kept = [uploader.add(bytes([n]) * 1000) for n in range(6)]

    assert [each is not None for each in kept] == [True] * 4 + [False] * 2
    assert uploader.dropped == 2
    assert sum(path.stat().st_size for path in (tmp_path / "spool").iterdir()) == 4000


def test_the_next_run_uploads_what_an_earlier_run_spooled(tmp_path: Path) -> None:
    with started(FakeUploads(), tmp_path / "spool", is_busy=lambda: True) as first:
        first.add(b"one")
        first.add(b"two")
    uploads = FakeUploads()
    with started(uploads, tmp_path / "spool") as second:
        second.add(b"three")

        assert second.wait_sent(20)

    assert uploads.taken == [b"one", b"two", b"three"]


def test_no_keyframe_is_started_while_live_poses_wait(tmp_path: Path) -> None:
    uploads, busy, asked = FakeUploads(), threading.Event(), threading.Event()
    busy.set()

    def is_busy() -> bool:
        asked.set()
        return busy.is_set()

    with started(uploads, tmp_path / "spool", is_busy=is_busy) as uploader:
        uploader.add(b"keyframe")
        assert asked.wait(20)
        assert uploads.taken == []

        busy.clear()
        assert uploader.wait_sent(20)


def test_no_part_is_started_while_live_poses_wait(tmp_path: Path) -> None:
    uploads, busy, asked, proceed = FakeUploads(), threading.Event(), threading.Event(), threading.Event()

    def is_busy() -> bool:
        if not uploads.parts.empty():
            busy.set()  # a pose arrives while the first part is sent
            asked.set()
        return busy.is_set() and not proceed.is_set()

    with started(uploads, tmp_path / "spool", is_busy=is_busy) as uploader:
        uploader.add(b"keyframe")
        assert asked.wait(20)
        assert uploads.parts.get(timeout=20) == 0
        assert uploads.parts.empty()
        assert uploads.taken == []

        proceed.set()
        assert uploader.wait_sent(20)

    assert [uploads.parts.get(timeout=20) for _ in range(2)] == [4, 8]


def test_a_keyframe_that_is_refused_for_good_is_dropped_and_the_next_is_uploaded(tmp_path: Path) -> None:
    uploads = FakeUploads()
    uploads.errors = [BadRequest("no")]
    with started(uploads, tmp_path / "spool") as uploader:
        uploader.add(b"bad")
        uploader.add(b"good")

        assert uploader.wait_sent(20)

    assert uploads.taken == [b"good"]
    assert (uploader.dropped, uploader.last_error) == (1, "no")


def test_keyframes_are_uploaded_although_is_busy_raises(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    uploads = FakeUploads()

    def is_busy() -> bool:
        raise KeyError("a bug of the program")

    with started(uploads, tmp_path / "spool", is_busy=is_busy) as uploader:
        for n in range(4):
            uploader.add(bytes([n]))

        assert uploader.wait_sent(20)

    assert len(uploads.taken) == 4
    assert len([record for record in caplog.records if record.exc_info]) == 1
