"""A recording is bounded, and holds no secret."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage
from rse_pf.services.custom.recording import LEFT_OUT, Recording, recorded_calls, without_secrets

TOKEN = SigningKey.from_seed(b"s" * 32, "k1").issue(
    "robot-1", now=1e9, token_id="t", settings=PlatformSettings().auth
)

NAMES = ("token", "robot_token", "password", "API-Key", "private_key", "Authorization", "aws-secret")


def recording(calls: int = 10, max_bytes: int = 1 << 20, until_s: float = 60.0) -> Recording:
    return Recording("icp", max_calls=calls, max_bytes=max_bytes, until_s=until_s)


def drained(made: Recording, piece: int = 7) -> bytes:
    stream = b""
    while made.waiting_bytes:
        stream += made.take(piece)
    return stream


def test_calls_come_back_as_they_were_however_the_stream_is_cut() -> None:
    made = recording()
    made.add({"points": np.arange(3.0), "raw": b"\x00\xff", 7: None}, {"x": 1.5}, None, 2.5, now=0.0)
    made.add({}, None, "degenerate", 0.0, now=1.0)

    first, second = recorded_calls(drained(made))

    np.testing.assert_array_equal(first.request["points"], [0.0, 1.0, 2.0])
    assert (first.request["raw"], first.request[7], first.reply) == (b"\x00\xff", None, {"x": 1.5})
    assert (first.failure, first.compute_ms, first.secrets) == (None, 2.5, 0)
    assert (second.reply, second.failure) == (None, "degenerate")


def test_a_recording_ends_at_its_number_of_calls_and_at_its_time() -> None:
    full, late = recording(calls=2), recording(until_s=5.0)
    for now in (0.0, 1.0, 2.0):
        full.add({}, {}, None, 0.0, now)
    late.add({}, {}, None, 0.0, 5.0)

    assert (full.calls, full.is_over(2.0)) == (2, True)
    assert (late.calls, late.is_over(4.9), late.is_over(5.0)) == (0, False, True)


def test_a_recording_never_takes_more_bytes_than_it_may() -> None:
    made = recording(calls=10_000, max_bytes=1000)
    for _ in range(100):
        made.add(b"x" * 300, {}, None, 0.0, 0.0)

    assert made.calls == 3
    assert made.left_out == 97
    assert made.waiting_bytes <= 1000 + 3 * 4


def test_a_stream_that_is_cut_off_gives_its_whole_calls_and_damage_is_a_typed_error() -> None:
    made = recording()
    made.add({"a": 1}, {}, None, 0.0, 0.0)
    stream = drained(made)

    assert list(recorded_calls(stream[:-1])) == []
    with pytest.raises(BadMessage):
        list(recorded_calls(b"\x03\x00\x00\x00\xc1\xc1\xc1"))


@pytest.mark.parametrize(
    "value",
    [
        TOKEN, f"Bearer {TOKEN}", f"see {TOKEN}, please", TOKEN.encode(), f'{{"t": "{TOKEN}"}}'.encode(),
        {"a": [{"b": TOKEN}]}, [[TOKEN]], "authorization: bearer abcdefgh1234",
        "https://b.example/x?X-Amz-Signature=0123&x=1", *({name: "short"} for name in NAMES),
        {NAMES[0]: b"short"},
    ],
    ids=repr,
)  # fmt: skip
def test_no_token_reaches_a_recording(value: Any) -> None:
    made = recording()
    made.add({"payload": value}, {"echo": value}, None, 0.0, 0.0)

    stream = drained(made)
    (call,) = recorded_calls(stream)

    for secret in (TOKEN.encode(), b"short", b"abcdefgh1234", b"0123"):
        assert secret not in stream
    assert call.secrets == 2
    assert LEFT_OUT.encode() in stream


@pytest.mark.parametrize(
    "value",
    [
        {"token": 5}, {"tokens": ["a"]}, "a sentence about a bearer of news", "eyJ", {"secret": ""},
        b"\xff" * 100, {"points": [1.0, 2.0]}, None, True, "1.2.3", {"description": "token"},
    ],
    ids=repr,
)  # fmt: skip
def test_what_is_no_secret_stays(value: Any) -> None:
    assert without_secrets(value) == (value, 0)
