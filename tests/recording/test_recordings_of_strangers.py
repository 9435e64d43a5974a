"""Hostile recordings of commands end in one line or a report, in bounded memory and time."""

from __future__ import annotations

import base64
import json
import os
import resource
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.recording import file_format
from rse_pf.extensions.recording.replay.limited import LimitedReplay
from rse_pf.pnp.problems import make_problem
from tests.kit.recorded_sessions import Made, jpeg

pytest.importorskip("mcap", reason="pip install 'rse-pf[local]'")

SETTINGS = PlatformSettings()
MAX_S = 20.0
"""Of one command, on a slow machine."""
NAME = f"{0:016x}:0"
"""Of the only command of a recording."""
Fields = dict[str, Any]


@pytest.fixture(scope="module")
def replay() -> Iterator[LimitedReplay]:
    with LimitedReplay(SETTINGS) as started:
        yield started


def written(folder: Path, edit: Callable[[str, Any], Any] = lambda kind, data: data, **more: Any) -> Path:
    """Record a command with thumbnail, odometry and answer, each of them as *edit* changes it."""
    made = Made(folder, edit=edit)
    made.send(make_problem(seed=8, n=60), thumbnail=jpeg(), T_odom_camera=np.eye(4), **more)
    return made.close()


def outcome(replay: LimitedReplay, path: Path) -> str:
    """Read a command; return "report", or the code of the error, which has a hint and one line."""
    begin = time.monotonic()
    refusal: RsePfError | None = None
    try:
        json.dumps(msgspec.to_builtins(replay.command(path, NAME), enc_hook=str))
    except RsePfError as error:
        refusal = error
    assert time.monotonic() - begin < MAX_S
    if refusal is None:
        return "report"
    assert refusal.hint
    assert "\n" not in refusal.message
    assert len(refusal.message) < 400
    return refusal.code


def edited(kind: str, change: Callable[[Any], Any]) -> Callable[[str, Any], Any]:
    """Return what decodes, changes and encodes the messages of *kind*."""

    def edit(of: str, data: Any) -> Any:
        if of != kind:
            return data
        if isinstance(data, dict):
            return change(data)
        return msgspec.msgpack.encode(change(msgspec.msgpack.decode(data)))

    return edit


def payload(**changes: Any) -> Callable[[Fields], Fields]:
    return lambda message: {**message, "payload": {**message["payload"], **changes}}


CAMERA = {"fx": 518.0, "fy": 519.0, "cx": 325.0, "cy": 253.0, "width": 640, "height": 480}
FLOODS = b"\xdd\x00\x98\x96\x80" + b"\x90" * 1_000_000
EDITS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "points that are no numbers": ("up", payload(points_world=[float("nan")] * 180)),
    "points at the end of the range": ("up", payload(points_world=[1e308] * 180)),
    "points that are texts": ("up", payload(points_world=["x"] * 180)),
    "no points": ("up", payload(points_world=[], pixels=[])),
    "more points than pixels": ("up", payload(points_world=[1.0] * 300_000)),
    "pixels at infinity": ("up", payload(pixels=[float("inf")] * 120)),
    "a camera that is no number": ("up", payload(camera={**CAMERA, "fx": float("nan")})),
    "an enormous camera": ("up", payload(camera={**CAMERA, "width": 2**31, "height": 2**31})),
    "a camera of one line": ("up", payload(camera={**CAMERA, "width": 16384, "height": 1})),
    "depths that are no numbers": ("up", payload(depths_m=[float("nan")] * 60)),
    "endless iterations": ("up", payload(options={"max_iterations": 2**31 - 1})),
    "an unknown engine": ("up", payload(options={"engine": "../../engine"})),
    "another service": ("up", lambda message: {**message, "service": "merge"}),
    "a service that leads out": ("up", lambda message: {**message, "service": "../../../etc"}),
    "an id beyond 64 bits": ("up", lambda message: {**message, "id": 2**64 - 1}),
    "a deadline that is no number": ("up", lambda message: {**message, "deadline_ms": float("nan")}),
    "an answer that is no number": (
        "down",
        lambda message: {**message, "reply": {**message["reply"], "T_camera_world": [float("nan")] * 16}},
    ),
    "an answer of zeros": (
        "down",
        lambda message: {**message, "reply": {**message["reply"], "T_camera_world": [0.0] * 16}},
    ),
    "inliers that are not there": (
        "down",
        lambda message: {**message, "reply": {**message["reply"], "inliers": [2**40, -1, 10**9]}},
    ),
    "a covariance at the end of the range": (
        "down",
        lambda message: {**message, "reply": {**message["reply"], "covariance": [1e308] * 36}},
    ),
    "an answer of another form": ("down", lambda message: {**message, "reply": [[[]]]}),
    "times that are no numbers": (
        "down",
        lambda message: {**message, "received_s": float("nan"), "sent_s": float("inf")},
    ),
    "odometry that is no number": ("odometry", lambda value: {**value, "T_odom_camera": [1e999] * 16}),
    "odometry of zeros": ("odometry", lambda value: {**value, "T_odom_camera": [0.0] * 16}),
    "odometry at the end of the range": ("odometry", lambda value: {**value, "T_odom_camera": [1e308] * 16}),
    "a thumbnail that is none": (
        "frames",
        lambda value: {**value, "data": base64.b64encode(b"\xff\xd8\xff").decode()},
    ),
    "a thumbnail that is not base64": ("frames", lambda value: {**value, "data": "%%%"}),
    "a thumbnail that says to be enormous": (
        "frames",
        lambda value: {**value, "data": _claims(60_000, 60_000)},
    ),
    "a thumbnail of many bytes": ("frames", lambda value: {**value, "data": "A" * 4_000_000}),
}


def _claims(width: int, height: int) -> str:
    data = jpeg()
    at = data.index(b"\xff\xc0") + 5
    return base64.b64encode(data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]).decode()


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_recording_is_a_report_or_one_line(
    tmp_path: Path, replay: LimitedReplay, name: str
) -> None:
    assert outcome(replay, written(tmp_path / "a", edited(*EDITS[name]))) in (
        "report",
        "bad-request",
        "bad-message",
        "too-large",
        "invalid-camera",
    )


@pytest.mark.parametrize(
    ("codec", "data"),
    [
        (
            "zlib",
            zlib.compress(
                b'{"type":"command","id":0,"service":"pnp","payload":"' + b"a" * (1 << 27) + b'"}', 9
            ),
        ),
        ("zlib", zlib.compress(b"[" * 1_000_000)),
        ("json", b"[" * 1_000_000),
        ("json", b'{"type":"command","id":0,"service":"pnp","payload":' + b"[" * 100_000),
        ("bin", b"\x84\xa4type\xa7command\xa2id\x00\xa7service\xa3pnp\xa7payload" + FLOODS),
        ("bin", b"\x91" * 1_000_000),
        ("bin", b""),
    ],
    ids=["zlib bomb", "deep zlib", "deep json", "deep payload", "ten million lists", "deep bin", "nothing"],
)
def test_a_bomb_in_a_recording_is_one_line(
    tmp_path: Path, replay: LimitedReplay, codec: str, data: bytes
) -> None:
    path = written(tmp_path / "a", lambda kind, sent: data if kind == "up" else sent, codec=codec)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    assert outcome(replay, path) in ("bad-request", "bad-message", "too-large")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 64 << 10, "KiB of this process"


def test_a_hundred_thousand_messages_beside_a_command_are_bounded(
    tmp_path: Path, replay: LimitedReplay
) -> None:
    made = Made(tmp_path / "a")
    odometry = {"command": NAME, "number": 0, "timestamp_s": 1.0, "T_odom_camera": np.eye(4).ravel().tolist()}
    for _ in range(100_000):
        made.writer.add_json(
            f"{file_format.ODOMETRY_PREFIX}robot-00000000", file_format.ODOMETRY_SCHEMA, made.now_ns, odometry
        )
    made.send(make_problem(seed=8, n=60))

    assert outcome(replay, made.close()) in ("report", "too-large")


def test_a_pipe_a_device_and_an_empty_folder_are_no_recording(tmp_path: Path, replay: LimitedReplay) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    (tmp_path / "folder.mcap").mkdir()

    for name in ("pipe", "zero", "folder"):
        assert outcome(replay, tmp_path / f"{name}.mcap") in ("bad-request", "usage")


def test_names_in_a_recording_make_no_file_and_reach_no_terminal_or_page_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "../../\x1b[2J<script>alert(1)</script>"
    path = written(tmp_path / "a", edited("down", lambda message: {**message, "server": name, "trace": name}))
    files = {each.name for each in path.iterdir()}
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path / "in")

    code = main(["replay", str(path), "--command", NAME, "--html", "page.html"])
    out = capsys.readouterr()

    assert code in (0, 1)
    assert "\x1b[2J" not in out.out + out.err
    assert "<script>alert" not in Path("page.html").read_text()
    assert {each.name for each in tmp_path.rglob("*")} == {"a", *files, "in", "page.html"}
