"""The contents of messages that a worker sends along save the recorder work, and change nothing recorded."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.extensions.recording.recorder_process import MessageRecorder
from rse_pf.extensions.recording.redact import ConnectionRedactor, Pseudonyms
from rse_pf.extensions.recording.tap import (
    ANSWER_WITH_POSE,
    DECODED_COMMAND,
    DOWN,
    UP,
    PipeEntry,
    PipeReader,
    RecordingTap,
    recording_pipe,
)
from rse_pf.extensions.recording.writer import RecordingWriter
from rse_pf.identity import RobotId
from rse_pf.pnp.problems import make_problem
from rse_pf.service import Registry
from rse_pf.services import pnp
from rse_pf.wire import CODECS, Command, Ping, make_codec
from tests.kit.worker_parts import worker_parts

ROBOT = RobotId("default", "robot-seven")
TOKEN = "eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyIn0.c2lnbmF0dXJl"
PAIRS = {DECODED_COMMAND: UP, ANSWER_WITH_POSE: DOWN}


def register(registry: Registry) -> None:
    pnp.register(registry, PlatformSettings().pnp)


def command(codec: str, **fields: Any) -> Command:
    p = make_problem(seed=1, n=60)
    request = pnp.make_request(p.points_world, p.pixels, p.camera, binary=codec == "bin")
    return Command(id=5, service="pnp", payload=request, **fields)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = recording_pipe()
    os.set_blocking(ends[0], False)
    yield ends
    for end in ends:
        os.close(end)


def handed(pipe: tuple[int, int], codec: str, *messages: Any) -> list[PipeEntry]:
    """Return what a worker hands over while a robot sends *messages*."""
    tap = RecordingTap(pipe[1], call_later=lambda seconds, call: None)
    with worker_parts(codec=codec, register=register) as worker:
        worker.dispatcher.context = dataclasses.replace(worker.context, tap=tap)
        connection, _ = worker.join(ROBOT.name)
        for message in messages:
            worker.say(connection, message)
        tap.flush()
    return list(PipeReader().entries(os.read(pipe[0], 1 << 20)))


def recorded(folder: Path, entries: list[PipeEntry], codec: str) -> list[tuple[str, int, bytes]]:
    """Return the messages of a recording of *entries*; the topics of connections without their numbers."""
    folder.mkdir()
    writer = RecordingWriter(folder, "s", started_ns=1, max_file_bytes=1 << 30, max_bytes=1 << 30)
    recorder = MessageRecorder(writer, Pseudonyms(b"k" * 32), SessionSettings(), "s")
    connection = recorder.open(codec, ROBOT)
    for kind, _, time_ns, data in entries:
        if kind == DECODED_COMMAND:
            recorder.record_decoded_command(connection, time_ns, data)
        elif kind == ANSWER_WITH_POSE:
            recorder.record_answer_with_pose(connection, time_ns, data)
        elif kind in (UP, DOWN):
            recorder.take(connection, "up" if kind == UP else "down", time_ns, data)
    writer.close()
    (file,) = folder.iterdir()
    with file.open("rb") as stream:
        return [
            (channel.topic.replace(connection.identity, "X"), message.log_time, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
        ]


@pytest.mark.parametrize("codec", ["json", "zlib"])
def test_a_command_that_was_read_and_its_answer_are_recorded_as_if_nothing_had_been_told(
    codec: str, pipe: tuple[int, int], tmp_path: Path
):
    reported = handed(pipe, codec, command(codec, stream="pose", keep=True), Ping(sent_s=1.0))
    heads = {DECODED_COMMAND: 9 + len("pose "), ANSWER_WITH_POSE: 8 + 16 * 8}
    plain = [
        PipeEntry(PAIRS.get(kind, kind), n, at, data[heads.get(kind, 0) :]) for kind, n, at, data in reported
    ]

    assert [each.kind for each in reported] == [1, UP, DOWN, DECODED_COMMAND, ANSWER_WITH_POSE, UP, DOWN]
    found = recorded(tmp_path / "reported", reported, codec)
    assert len(found) == 7
    assert found == recorded(tmp_path / "plain", plain, codec)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "payload", [{"note": "robot-seven"}, "robot-seven", None, [1.0], {"camera": "robot-seven"}]
)
def test_nothing_is_reported_of_a_command_that_was_not_read_as_a_request(
    codec: str, payload: Any, pipe: tuple[int, int]
):
    reported = handed(pipe, codec, Command(id=5, service="pnp", payload=payload))

    assert [each.kind for each in reported[3:]] == [UP, DOWN]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("words", ["robot-seven", TOKEN])
def test_a_name_or_a_token_in_the_words_of_a_command_is_not_recorded(codec: str, words: str):
    data = make_codec(codec).encode(command(codec, trace=words))
    redactor = ConnectionRedactor(make_codec(codec), ROBOT, Pseudonyms(b"k" * 32), max_inflated_bytes=1 << 20)

    kept = redactor.decoded_command(5, f" {words}".encode(), data)

    if words == TOKEN:
        assert kept is None
    else:
        assert kept is not None
        assert words.encode() not in kept.text
        assert make_codec(codec).decode_from_robot(kept.data).trace == redactor.robot
