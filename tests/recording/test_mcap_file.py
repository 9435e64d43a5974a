"""A recording's file is read by the library `mcap`, whole or cut off anywhere."""

from __future__ import annotations

import errno
import io
import os
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from rse_pf.recording.mcap_file import MAX_CHUNK_NS, McapFile

SECOND = 1_000_000_000


@pytest.fixture
def fd(tmp_path: Path) -> Iterator[int]:
    made = os.open(tmp_path / "file.mcap", os.O_RDWR | os.O_CREAT)
    yield made
    os.close(made)


def content(fd: int) -> bytes:
    return os.pread(fd, os.fstat(fd).st_size, 0)


def written(fd: int, chunks: int = 3, on_chunk: Callable[[int], None] = lambda size: None) -> McapFile:
    file = McapFile(fd)
    file.begin("rse-pf", "rse-pf test", {"rse_pf": {"format": "1"}})
    up = file.channel("/wire/0/up", "rse-pf-wire", metadata={"codec": "bin"})
    poses = file.channel("/poses/a", "json", ("Pose", "jsonschema", b"{}"))
    for chunk in range(chunks):
        for number in range(20):
            file.add(up, SECOND * (chunk + 1) + number, bytes([chunk, number]) * 40)
        file.add(poses, SECOND * (chunk + 1) + 5, b'{"chunk":%d}' % chunk)
        file.flush()
        on_chunk(file.size_bytes)
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


def test_any_chunk_is_found_by_its_time(fd: int):
    written(fd).finish()

    found = make_reader(io.BytesIO(content(fd))).iter_messages(
        starting_at=2 * SECOND, ending_before=3 * SECOND
    )

    assert {each[2].data[0] for each in found if each[1].topic == "/wire/0/up"} == {1}


def whole_chunks(data: bytes) -> int:
    found = 0
    try:
        for record in StreamReader(io.BytesIO(data), emit_chunks=True, validate_crcs=True).records:
            found += isinstance(record, Chunk)
    except (McapError, EOFError, struct.error):
        pass
    return found


def test_a_file_that_is_cut_off_anywhere_has_its_whole_chunks(fd: int):
    ends: list[int] = []
    written(fd, on_chunk=ends.append)
    whole = content(fd)

    for size in random.Random(7).sample(range(60, len(whole)), 60):
        assert whole_chunks(whole[:size]) >= sum(end <= size for end in ends)
    assert whole_chunks(whole) == len(ends) == 3


def test_a_chunk_is_due_half_a_second_after_its_first_message(fd: int):
    file = McapFile(fd)
    file.begin("rse-pf", "")
    channel = file.channel("/a", "x")
    assert not file.is_due(9 * SECOND)

    file.add(channel, SECOND, b"")

    assert [file.is_due(SECOND + MAX_CHUNK_NS + ns) for ns in (-1, 0)] == [False, True]


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
