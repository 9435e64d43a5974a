"""Files of requests: exact, readable by people, and refused with a line when they are none."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import UsageError
from rse_pf.services.custom.recording import RecordedCall
from rse_pf.services.custom.request_files import from_json, read_requests, to_json, write_requests

VALUES: list[Any] = [
    None, True, 1, -0.1, 1e300, "text é\u2028", b"\x00\xff", [1, [2]], {"a": {"b": [b"x"]}}, {1: "a", "b": 2},
    {"$bytes": "not bytes"}, {"$map": 1}, {"$array": [1]}, {},
]  # fmt: skip


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_survives_as_it_was(value: Any) -> None:
    assert from_json(json.loads(json.dumps(to_json(value)))) == value


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint32])
def test_an_array_survives_with_its_type_and_every_bit(dtype: type) -> None:
    array = np.array([0, 1 / 3, 2.5, 4e9], dtype)

    back = from_json(json.loads(json.dumps(to_json({"a": array}))))["a"]

    assert back.dtype == dtype
    np.testing.assert_array_equal(back, array)


def test_a_recording_is_a_file_of_its_owner_and_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "live.jsonl"
    calls = [
        RecordedCall({"p": np.zeros(2)}, {"x": 1}, None, 1.25, 0),
        RecordedCall({"p": "a"}, None, "bad-request", 0.0, 1),
    ]
    write_requests(path, "icp", calls)

    read = read_requests(path)

    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read.service == "icp"
    (first, good), (second, bad) = read.calls
    assert (first, second) == ("live.jsonl number 1", "live.jsonl number 2")
    np.testing.assert_array_equal(good["request"]["p"], [0.0, 0.0])
    assert (good["reply"], good["compute_ms"], bad["failure"], bad["secrets"]) == (
        {"x": 1},
        1.25,
        "bad-request",
        1,
    )
    assert "reply" not in bad


def test_one_recorded_request_is_a_file_of_requests_too(tmp_path: Path) -> None:
    path = tmp_path / "example.json"
    path.write_text('{\n "request": {"a": 1},\n "tolerance": 0.5\n}\n')

    assert read_requests(path).calls == [("example.json", {"request": {"a": 1}, "tolerance": 0.5})]


HEAD = '{"format": "rse-pf-requests", "version": 1, "service": "icp", "requests": 1}\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ("[1]", "holds no request"),
        ('{"reply": 1}', "holds no request"),
        (HEAD + "{", "line 2 is not JSON"),
        (HEAD + "[]", "line 2 holds no request"),
        (HEAD + '{"request": {"$bytes": "!"}}', "line 2 holds no request"),
        (HEAD + '{"request": {"$array": "int7", "values": []}}', "line 2 holds no request"),
        (HEAD.replace('"version": 1', '"version": 9'), "is of version 9"),
    ],
)
def test_a_file_that_holds_no_requests_is_refused_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "wrong.jsonl"
    path.write_text(text)

    with pytest.raises(UsageError, match=says) as told:
        read_requests(path)
    assert told.value.hint


def test_a_file_that_is_missing_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot read"):
        read_requests(tmp_path / "nothing")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="it is no text"):
        read_requests(tmp_path / "binary")
    with pytest.raises(UsageError, match="cannot write"):
        write_requests(tmp_path / "no" / "folder", "icp", [])
