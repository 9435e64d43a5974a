"""Recordings are bounded in size, and a disk that is full costs messages, not the recorder."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.recording.writer import RecordingWriter, with_recordings

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


def writer(folder: Path, server: str = "server-1", **bounds: int) -> RecordingWriter:
    bounds = {"max_file_bytes": 1 << 20, "max_bytes": 1 << 30, **bounds}
    return RecordingWriter(folder, server, started_ns=START, **bounds)


def fill(target: RecordingWriter, seconds: int, from_s: int = 0, size: int = 100_000) -> None:
    channel = target.channel("/wire/0000000000000000/up", "rse-pf-wire", {"codec": "bin"})
    for second in range(from_s, from_s + seconds):
        now = START + second * SECOND
        target.add(channel, now, os.urandom(size))
        target.flush(now + SECOND // 2)


def names(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


def messages(file: Path) -> list[Any]:
    with file.open("rb") as stream:
        return list(make_reader(stream, validate_crcs=True).iter_messages())


def test_a_file_that_is_full_is_followed_by_the_next_and_a_channel_goes_on(tmp_path: Path):
    made = writer(tmp_path)
    fill(made, 25)
    made.close()

    assert names(tmp_path) == [f"20231114T221320Z-server-1-{k:04d}.mcap" for k in (1, 2, 3)]
    found = [messages(tmp_path / each) for each in names(tmp_path)]
    assert sum(map(len, found)) == 25
    assert all(channel.metadata == {"codec": "bin"} for each in found for _, channel, _ in each)


def test_the_oldest_files_are_deleted_but_none_that_is_being_written(tmp_path: Path):
    other = writer(tmp_path, "server-0")
    fill(other, 2)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "my.mcap").write_bytes(bytes(3 << 20))

    made = writer(tmp_path, max_bytes=3 << 20)
    fill(made, 60)

    left = names(tmp_path)
    assert {"notes.txt", "my.mcap", "20231114T221320Z-server-0-0001.mcap"} <= set(left)
    assert "20231114T221320Z-server-1-0001.mcap" not in left
    assert sum(each.stat().st_size for each in tmp_path.glob("2023*")) <= (4 << 20) + 200_000
    for each in (made, other):
        each.close()


def test_a_full_disk_costs_messages_and_a_new_file_follows_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = writer(tmp_path)
    fill(made, 3)
    write = os.write

    def full(fd: int, data: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    fill(made, 4, from_s=3)
    problem, dropped = made.problem, made.dropped
    monkeypatch.setattr(os, "write", write)
    fill(made, 3, from_s=20)
    made.close()

    assert problem == "No space left on device"
    assert dropped == 4
    assert made.problem == ""
    first, last = sorted(tmp_path.iterdir())
    assert len(messages(last)) == 3
    chunks = 0
    with first.open("rb") as cut, suppress(McapError):
        for record in StreamReader(cut, emit_chunks=True).records:
            chunks += isinstance(record, Chunk)
    assert chunks >= 2


@pytest.mark.parametrize(
    ("folder", "message"),
    [("file", "is a file"), ("file/below", "cannot write recordings"), ("/proc/nothing/x", "cannot write")],
)
def test_a_folder_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path, folder: str, message: str):
    (tmp_path / "file").write_text("")

    with pytest.raises(UsageError, match=message) as refused:
        with_recordings(PlatformSettings(), tmp_path / folder)

    assert refused.value.hint
    assert "\n" not in refused.value.message
