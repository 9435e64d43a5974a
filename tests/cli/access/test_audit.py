"""`rse-pf audit show`: what it prints of logs on this machine and of those in the bucket."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.log import record_once
from rse_pf.aws.storage.audit_archive import Shipper
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.cli.main import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for row, (who, action, subject) in enumerate(
        [
            ("server-1", "auth.accepted", "robot-1"),
            ("operator", "robot.disabled", "robot-1"),
            ("server-1", "auth.refused", ""),
        ]
    ):
        record_once(
            tmp_path / "audit", who, action, subject, wall_clock=lambda at=row: 1e9 + at,
            reason="a reason\n\x1b[2J",
        )  # fmt: skip
    return tmp_path / "audit"


def test_show_prints_all_logs_in_the_order_of_time(folder: Path, capsys: Capture):
    assert main(["audit", "show", str(folder)]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[2:4] for line in lines] == [
        ["server-1", "auth.accepted"], ["operator", "robot.disabled"], ["server-1", "auth.refused"],
    ]  # fmt: skip
    assert lines[0].startswith("2001-09-09 01:46:40Z server-1 auth.accepted robot-1 reason=")


def test_show_cannot_be_made_to_write_control_characters(folder: Path, capsys: Capture):
    main(["audit", "show", str(folder), "--last", "1"])

    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert "\x1b" not in out
    assert r'reason="a reason\n\u001b[2J"' in out


def test_show_prints_all_servers_of_a_cloud_and_keeps_the_files(cloud: Any, tmp_path: Path, capsys: Capture):
    for instance, actions in (
        ("i-1", ("auth.accepted", "auth.cut-off", "server.over")),
        ("i-2", ("auth.x",)),
    ):
        shipper = Shipper(
            tmp_path / instance, S3Store(cloud, "audit-logs"), marks_file=tmp_path / f"{instance}.json",
            instance=lambda name=instance: name,
        )  # fmt: skip
        for row, action in enumerate(actions):
            record_once(tmp_path / instance, instance, action, wall_clock=lambda at=row: 1e9 + at)
            shipper.ship()

    assert main(["audit", "show", "--cloud", "--out", "kept", "--only", "auth"]) == 0
    shown = capsys.readouterr().out
    assert [line.split()[2] for line in shown.splitlines()] == ["i-1", "i-2", "i-1"]

    assert main(["audit", "show", "kept", "--only", "auth"]) == 0
    assert capsys.readouterr().out == shown


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--cloud"], "holds no audit log yet"),
        (["somewhere", "--cloud"], "exclude each other"),
        (["somewhere"], "there is no somewhere"),
        (["full"], "there is no audit log in full"),
        (["--out", "x"], "--out is for --cloud"),
        (["--cloud", "--out", "full"], "not empty"),
        (["--last", "0"], "shows no entry"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(
    cloud: Any, capsys: Capture, words: list[str], problem: str
) -> None:
    Path("full").mkdir()
    Path("full/file").write_text("")

    assert main(["audit", "show", *words]) == 2
    error = capsys.readouterr().err
    assert problem in error
    assert error.count("\n  hint: ") == 1
