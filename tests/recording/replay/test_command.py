"""`rse-pf replay` on recordings, and on files that anybody may have written."""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.cli.main import main
from rse_pf.extensions.recording.mcap_file import McapFile
from rse_pf.extensions.recording.replay import limited
from rse_pf.pnp.problems import make_degenerate, make_problem
from rse_pf.wire import Result
from tests.kit.recorded_sessions import Made, jpeg


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A folder with a good, a weak and a failed command, and one whose answer was forged; their names."""
    made = Made(tmp_path_factory.mktemp("replay") / "rec")
    names = {
        "good": made.send(1),
        "weak": made.send(make_problem(seed=9, n=60, outlier_ratio=0.8), thumbnail=jpeg(), robot=1),
        "failed": made.send(make_degenerate("mirrored", seed=1), robot=2, codec="json"),
    }
    return made.close(), names


class InThisProcess:
    """Stands for the process with limits, which takes half a second to start."""

    def __init__(self, target: str, _limits: object, *, configuration: str, **_: object) -> None:
        assert target == "rse_pf.extensions.recording.replay.limited:replayer"
        self._answer = limited.replayer(configuration)

    def call(self, data: bytes, timeout_s: float) -> bytes:
        """Return what the process would return."""
        assert timeout_s > 0
        return self._answer(data)

    def close(self) -> None:
        """Do nothing."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replay in this process."""
    monkeypatch.setattr(limited, "LimitedProcesses", InThisProcess)


def printed(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> str:
    assert main(["replay", *map(str, words)]) == code
    told = capsys.readouterr()
    assert told.err == ""
    return told.out


def as_json(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(printed(capsys, *words, "--json", code=code))
    return found


@pytest.mark.usefixtures("quick")
def test_replay_lists_what_went_wrong_worst_first(
    recording: tuple[Path, dict[str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, names = recording

    out = printed(capsys, folder)

    assert "3 commands of 3 robots" in out
    assert out.index(names["failed"]) < out.index(names["weak"])
    assert "degenerate" in out
    assert names["good"] not in out
    assert f"rse-pf replay {folder} --command {names['failed']}" in out


@pytest.mark.usefixtures("quick")
def test_json_of_a_recording_has_the_counts_and_the_troubles(
    recording: tuple[Path, dict[str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    seen = as_json(capsys, recording[0])

    assert (seen["commands"], seen["equal"], seen["different"]) == (3, 3, 0)
    assert seen["by_kind"] == {"failed": 1, "weak": 1}
    assert [each["id"] for each in seen["troubles"]] == [recording[1]["failed"], recording[1]["weak"]]


@pytest.mark.usefixtures("quick")
def test_a_command_is_shown_with_its_evidence_and_on_a_page(
    recording: tuple[Path, dict[str, str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, names = recording
    page = tmp_path / "page.html"

    out = printed(capsys, folder, "--command", names["weak"], "--html", page)
    again = as_json(capsys, folder, "--command", names["weak"])

    assert "equal to the byte" in out
    assert "low-inlier-ratio" in out
    assert (again["commands"], again["equal"], again["different"]) == (1, 1, 0)
    broken = [each["name"] for each in again["rules"] if each["measured"] < each["limit"]]
    assert "low-inlier-ratio" in broken
    text = page.read_text(encoding="utf-8")
    assert "data:image/png;base64," in text
    assert "on the thumbnail of the frame" in text
    for outside in ("http:", "https:", "<script", 'src="/', "url("):
        assert outside not in text


@pytest.mark.usefixtures("quick")
def test_a_changed_answer_is_reported_and_gives_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = Made(tmp_path / "rec")
    made.send(1, codec="json")
    pose = {"T_camera_world": np.eye(4).ravel().tolist(), "inliers": [1], "rmse_px": 1.0}
    words = {"verdict": "ok", "reason": "", "engine": "native"}
    forged = Result(id=1, reply={**pose, "covariance": [1.0] * 21, **words})
    name = made.send(2, codec="json", answer=forged)
    folder = made.close()

    out = printed(capsys, folder, "--all", code=1)

    assert "1 equal to the byte, 1 different" in out
    assert f"{name}  the pose moved by" in out


@pytest.mark.usefixtures("quick")
def test_names_in_a_recording_cannot_write_to_the_terminal_or_the_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = Made(tmp_path / "rec", server="\x1b[2Jserver<script>")
    made.send(make_degenerate("mirrored", seed=1), trace="<img src=x>")
    folder, page = made.close(), tmp_path / "page.html"

    out = printed(capsys, folder, "--html", page)

    assert "\x1b" not in out
    text = page.read_text(encoding="utf-8")
    assert "<script" not in text
    assert "<img src=x" not in text


def hostile(path: Path, kind: str) -> Path:
    """Write a file that asks for more than it is given."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT)
    file = McapFile(fd)
    metadata = {"rse_pf": {"format": "1"}}
    file.begin("rse-pf", "rse-pf", metadata)
    if kind == "channels":
        for number in range(60_000):
            file.channel(f"/wire/{number:016x}/up", "rse-pf-wire", None, {"codec": "bin"})
    wire = {"codec": "zlib" if kind == "bomb" else "json", "robot": "robot-1"}
    channel = file.channel("/wire/0000000000000000/up", "rse-pf-wire", None, wire)
    data = {
        "bomb": zlib.compress(b'{"type":"command","id":1,"service":"' + b" " * 50_000_000, 9),
        "nested": b'{"type":"command","id":1,"service":"pnp","payload":' + b"[" * 100_000,
        "channels": b"{}",
    }[kind]
    file.add(channel, 1, data)
    file.finish()
    os.close(fd)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bomb", "nested", "channels"])
def test_a_hostile_file_costs_one_line(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["replay", str(hostile(tmp_path / "a.mcap", kind)), "--command", "0" * 16 + ":1"])

    told = capsys.readouterr()
    assert (code, told.out) == (1, "")
    assert len(told.err.splitlines()) == 2
