"""No name and no token reaches a recording; everything else stays as it was on the wire."""

from __future__ import annotations

import zlib
from typing import Any

import pytest

from rse_pf.extensions.recording.redact import ConnectionRedactor, Pseudonyms
from rse_pf.identity import RobotId
from rse_pf.wire import (
    Command,
    Failure,
    Hello,
    Limits,
    Renew,
    Result,
    Subscribe,
    Update,
    Welcome,
    make_codec,
)

ROBOT = RobotId("acme works", "müller-7")
NAMES = ("acme works", "müller-7", "m\\u00fcller-7")
TOKEN = "eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyIn0.c2lnbmF0dXJl"
SECRET = "of somebody else"
CODECS = ("zlib", "json", "bin")
ANSWER_WITH_POSE = {"camera": {"fx": 1.0}, "points_world": [1.0] * 12, "pixels": [2.0] * 8}


def redactor(codec: str, robot: RobotId = ROBOT, **more: Any) -> ConnectionRedactor:
    return ConnectionRedactor(
        make_codec(codec), robot, Pseudonyms(b"k" * 32), max_inflated_bytes=1 << 20, **more
    )


def command(number: int = 1, **fields: Any) -> Command:
    return Command(id=number, service="pnp", payload=ANSWER_WITH_POSE, **fields)


@pytest.mark.parametrize("codec", CODECS)
def test_a_command_and_its_answer_stay_as_they_were(codec: str):
    judge, encode = redactor(codec), make_codec(codec).encode
    up, down = (
        encode(command(stream="pose")),
        encode(Result(id=1, reply={"verdict": "ok"}, server="server-1")),
    )

    kept = judge.up(up), judge.down(down)

    assert [each.data for each in kept if each] == [up, down]
    assert [(each.type, each.service) for each in kept if each] == [("command", "pnp"), ("result", "pnp")]


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "message",
    [
        Renew(token=TOKEN),
        Subscribe(id=3, topic="live/kitchen"),
        Command(id=2, service="merge", payload={"robot": "müller-7"}),
        Command(id=2, service="live", payload={}),
        Command(id=2, service="pnp", payload={**ANSWER_WITH_POSE, "note": TOKEN}),
    ],
)
def test_what_may_hold_a_token_or_a_name_is_left_out(codec: str, message: Any):
    judge = redactor(codec)

    assert judge.up(make_codec(codec).encode(message)) is None
    assert judge.left_out == 1


@pytest.mark.parametrize("codec", CODECS)
def test_an_answer_to_a_command_that_was_left_out_is_left_out(codec: str):
    judge, encode = redactor(codec), make_codec(codec).encode
    judge.up(encode(Command(id=2, service="merge")))

    assert judge.down(encode(Result(id=2, reply={"robot": "someone"}))) is None
    assert judge.down(encode(Update(id=3, topic="live/kitchen", seq=1))) is None


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "message",
    [
        command(trace="müller-7", stream="of acme works"),
        Command(id=1, service="pnp", payload={**ANSWER_WITH_POSE, "note": ["I am müller-7"]}),
        Command(id=1, service="pnp", payload={**ANSWER_WITH_POSE, "seen by müller-7": 1}),
        Hello(sdk="müller-7"),
    ],
)
def test_a_name_in_a_free_text_becomes_a_pseudonym(codec: str, message: Any):
    kept = redactor(codec).up(make_codec(codec).encode(message))

    assert kept is not None
    text = zlib.decompress(kept.data) if codec == "zlib" else kept.data
    assert not any(name.encode() in text for name in NAMES)
    assert text.count(b"robot-") + text.count(b"tenant-") >= 1


@pytest.mark.parametrize("codec", CODECS)
def test_a_welcome_names_the_pseudonym_and_a_refusal_no_robot(codec: str):
    judge, codec_ = redactor(codec), make_codec(codec)
    limits = Limits(max_message_bytes=1, max_in_flight=1)
    welcome = Welcome(server="s", session="x", robot="müller-7", protocol=1, limits=limits, clock_s=1.0)

    kept = judge.down(codec_.encode(welcome))
    refusal = judge.down(codec_.encode(Failure(code="busy", message="robot müller-7 is too fast")))

    assert kept is not None
    assert codec_.decode_from_server(kept.data).robot == judge.robot
    assert refusal is not None
    assert judge.robot in codec_.decode_from_server(refusal.data).message


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", ["camera", "native", "pnp", "a", "command", "T_camera_world", "1"])
def test_a_robot_that_has_a_word_of_the_protocol_for_a_name_changes_no_command(codec: str, name: str):
    sent = make_codec(codec).encode(
        Command(id=1, service="pnp", payload={**ANSWER_WITH_POSE, "options": {"engine": "native"}}, keep=True)
    )

    kept = redactor(codec, RobotId("default", name)).up(sent)

    assert kept is not None
    assert kept.data == sent


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("data", [b"", b"{", b"\xff" * 50, b'{"type":"renew","token":"%s"' % TOKEN.encode()])
def test_what_cannot_be_decoded_is_left_out(codec: str, data: bytes):
    judge = redactor(codec)

    assert judge.up(data) is None
    assert judge.down(data) is None


def test_a_bomb_is_not_inflated():
    assert redactor("zlib").up(zlib.compress(bytes(3_000_000), 9)) is None


@pytest.mark.parametrize("codec", CODECS)
def test_a_message_that_holds_a_secret_is_left_out(codec: str):
    sent = make_codec(codec).encode(command(trace=SECRET))

    assert redactor(codec, secrets=[SECRET]).up(sent) is None
    assert redactor(codec, secrets=["another"]).up(sent) is not None


def test_a_robot_has_one_pseudonym_in_a_recording_and_another_in_the_next():
    first, second = Pseudonyms(b"a" * 32), Pseudonyms(b"b" * 32)

    assert first.robot(ROBOT) == Pseudonyms(b"a" * 32).robot(ROBOT) != second.robot(ROBOT)
    assert first.robot(ROBOT) != first.robot(RobotId("default", ROBOT.name))
    assert len(first.robot(ROBOT)) == len("robot-XXXXXXXX")
