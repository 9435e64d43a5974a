"""A recording's file is read by the library `mcap`, whole or cut off anywhere."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from rse_pf.extensions.recording.mcap_file import McapFile

SECOND = 1_000_000_000


@pytest.fixture
def fd(tmp_path: Path) -> Iterator[int]:
    made = os.open(tmp_path / "file.mcap", os.O_RDWR | os.O_CREAT)
    yield made
    os.close(made)


def content(fd: int) -> bytes:
    return os.pread(fd, os.fstat(fd).st_size, 0)


def written(fd: int, chunks: int = 3) -> McapFile:
    file = McapFile(fd)
    file.begin("rse-pf", "rse-pf test", {"rse_pf": {"format": "1"}})
    up = file.channel("/wire/0/up", "rse-pf-wire", metadata={"codec": "bin"})
    poses = file.channel("/poses/a", "json", ("Pose", "jsonschema", b"{}"))
    for chunk in range(chunks):
        for number in range(20):
            file.add(up, SECOND * (chunk + 1) + number, bytes([chunk, number]) * 40)
        file.add(poses, SECOND * (chunk + 1) + 5, b'{"chunk":%d}' % chunk)
        file.flush()
    return file


def test_the_library_finds_every_message_channel_schema_and_metadata_record(fd: int):
    written(fd).finish()

    reader = make_reader(io.BytesIO(content(fd)), validate_crcs=True)
    messages = list(reader.iter_messages())
    summary = reader.get_summary()

    assert [len(messages), len(list(reader.iter_messages(topics=["/poses/a"])))] == [63, 3]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 63
    assert (summary.statistics.message_start_time, len(summary.chunk_indexes)) == (SECOND, 3)
    assert messages[0][1].metadata == {"codec": "bin"}
    assert messages[0][2].data == bytes(80)
    assert [each.metadata for each in reader.iter_metadata()] == [{"format": "1"}]
    assert reader.get_header().profile == "rse-pf"


def test_what_a_full_disk_took_of_a_chunk_is_cut_off_again(fd: int, monkeypatch: pytest.MonkeyPatch):
    file = written(fd, chunks=2)
    before, write = content(fd), os.write
    file.add(1, 9 * SECOND, b"x" * 3000)

    def half(target: int, data: memoryview) -> int:
        if len(data) < 2000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(target, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", half)
    with pytest.raises(OSError, match="No space"):
        file.flush()

    assert content(fd) == before
