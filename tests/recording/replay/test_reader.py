"""Recordings are read in order, up to where they are cut off; a file that is no recording is an error."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rse_pf.errors import BadRequest, LimitExceeded, RsePfError, UnsupportedProtocol, UsageError
from rse_pf.extensions.recording import file_format, reader
from rse_pf.extensions.recording.reader import open_recording
from rse_pf.wire import Command, Result
from tests.kit.recorded_sessions import START_NS, Made, jpeg


def test_commands_come_with_their_answers_in_the_order_in_which_they_were_answered(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    slow = made.send(1, took_ns=500_000_000, is_answered=False)
    fast = [made.send(seed, codec=codec) for seed, codec in ((2, "zlib"), (3, "json"))]

    commands = list(open_recording(made.close()).commands())

    assert [each.id for each in commands] == [*fast, slow]
    assert [each.codec for each in commands] == ["zlib", "json", "bin"]
    assert isinstance(commands[0].command, Command)
    assert isinstance(commands[0].reply, Result)
    assert commands[0].round_trip_ms == pytest.approx(3.0)
    assert commands[0].sent_s == pytest.approx(START_NS / 1e9 + 0.4)
    assert commands[2].reply is None
    assert commands[2].round_trip_ms is None
    assert commands[0].about["side"] == "server"


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_read_up_to_its_last_whole_chunk(tmp_path: Path, share: float) -> None:
    made = Made(tmp_path / "a")
    sent = [made.send(seed) for seed in range(30)]
    path = made.file()
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])

    recording = open_recording(path)
    read = [each.id for each in recording.commands() if each.reply_bytes]

    assert read == sent[: len(read)]
    assert len(read) >= share * 30 - 6
    assert recording.cut == [path]


def test_a_damaged_chunk_ends_the_file(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    for seed in range(30):
        made.send(seed)
    path = made.file()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)

    recording = open_recording(path)

    assert 0 < len(list(recording.commands())) < 30
    assert recording.cut


def test_a_file_that_another_library_wrote_is_read(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    made.send(1)
    (command,) = open_recording(made.file()).commands()
    for compression in (CompressionType.NONE, CompressionType.LZ4):
        path = tmp_path / f"{compression.name}.mcap"
        with path.open("wb") as file:
            writer = Writer(file, compression=compression)
            writer.start(profile="rse-pf")
            wire = file_format.WireChannel("0" * 16, "up", "bin", "", "robot-1", "tenant-1")
            channel = writer.register_channel(
                file_format.wire_topic("0" * 16, "up"), file_format.WIRE_ENCODING, 0,
                file_format.wire_metadata(wire),
            )  # fmt: skip
            writer.add_message(channel, START_NS, command.command_bytes, START_NS)
            writer.finish()

        assert [each.command_bytes for each in open_recording(path).commands()] == [command.command_bytes]


def _wrong(tmp_path: Path, name: str) -> Path:
    """Return the path of a file that is no recording."""
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif name == "empty":
        path.write_bytes(b"")
    elif name == "text":
        path.write_bytes(b"no recording")
    elif name == "magic":
        path.write_bytes(b"\x89MCAP0\r\n")
    elif name == "length":
        path.write_bytes(b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 1 << 60))
    elif name in ("profile", "newer", "zstd", "bomb"):
        kind = CompressionType.ZSTD if name == "zstd" else CompressionType.LZ4
        with path.open("wb") as file:
            writer = Writer(file, compression=kind, chunk_size=1 << 30)
            writer.start(profile="ros2" if name == "profile" else "rse-pf")
            version = str(file_format.FORMAT_VERSION + 1) if name == "newer" else "1"
            writer.add_metadata(file_format.METADATA_NAME, {"format": version})
            channel = writer.register_channel("/wire/0000000000000000/up", "rse-pf-wire", 0)
            writer.add_message(channel, 1, bytes(34_000_000 if name == "bomb" else 1000), 1)
            writer.finish()
    return path


@pytest.mark.parametrize(
    ("name", "kind", "says"),
    [
        ("missing", UsageError, "there is no file"),
        ("folder", UsageError, "there is no recording in"),
        ("empty", BadRequest, "is empty"),
        ("text", BadRequest, "is not a recording"),
        ("magic", BadRequest, "is not a recording"),
        ("length", BadRequest, "is not a recording"),
        ("profile", BadRequest, "is not a recording"),
        ("newer", UnsupportedProtocol, "has format 2"),
        ("zstd", LimitExceeded, "'zstd' are not read"),
        ("bomb", LimitExceeded, "is above"),
    ],
)
def test_what_is_no_recording_is_reported_in_one_line(
    tmp_path: Path, name: str, kind: type[RsePfError], says: str
) -> None:
    with pytest.raises(kind, match=says) as error:
        list(open_recording(_wrong(tmp_path, name)).commands())

    assert error.value.hint
    assert "\n" not in error.value.message


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_command_is_found_without_opening_the_chunks_of_other_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_finished: bool
) -> None:
    made = Made(tmp_path / "a")
    names = [
        made.send(seed, robot=seed // 20, thumbnail=jpeg() if seed == 50 else None) for seed in range(60)
    ]
    folder = made.close()
    if not is_finished:
        (file,) = folder.iterdir()
        file.write_bytes(file.read_bytes()[:-1])
    opened: list[int] = []
    original = reader._decompress

    def noting(chunk: Any) -> bytes:
        opened.append(1)
        return original(chunk)

    monkeypatch.setattr(reader, "_decompress", noting)
    recording = open_recording(folder)
    expected = {each.id: each for each in recording.commands()}
    every = len(opened)
    opened.clear()

    found = recording.find(names[50])

    assert (found.command_bytes, found.reply_bytes) == (
        expected[names[50]].command_bytes, expected[names[50]].reply_bytes
    )  # fmt: skip
    assert found.thumbnail == expected[names[50]].thumbnail is not None
    assert (len(opened) < every / 2) == is_finished
    with pytest.raises(BadRequest, match="no command"):
        recording.find(f"{names[50].partition(':')[0]}:7")


def _without_checksums(path: Path) -> Path:
    """Return a copy in which damage is not noticed by the checksums of chunks."""
    copy = path.with_name("copy.mcap")
    with path.open("rb") as source, copy.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="rse-pf")
        channels: dict[str, int] = {}
        for _, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, 0, channel.metadata
                )
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    return copy


@pytest.mark.slow
def test_no_bytes_raise_anything_but_a_named_error(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    for seed in range(4):
        made.send(seed, codec=("bin", "zlib", "json")[seed % 3], thumbnail=jpeg(), T_odom_camera=np.eye(4))
    good = _without_checksums(made.file()).read_bytes()
    path, rng, read = tmp_path / "b.mcap", np.random.default_rng(1), 0
    for _ in range(1500):
        data = bytearray(good)
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(data[: rng.integers(len(data))] if rng.random() < 0.3 else data)
        try:
            for command in open_recording(path).commands():
                read += bool(command.id)
                _ = command.command, command.reply
        except RsePfError:
            continue
    assert read > 500
