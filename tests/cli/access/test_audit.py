"""`rse-pf audit`: what it prints, and what it exits with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.audit.log import record_once
from rse_pf.cli.main import main


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


def test_verify_prints_a_line_for_each_chain(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["audit", "verify", str(folder)]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert [line.rpartition(":")[0] for line in lines] == [
        "operator: 1 entry good, head 1", "server-1: 2 entries good, head 2",
    ]  # fmt: skip


def test_verify_names_file_entry_and_what_is_wrong(folder: Path, capsys: pytest.CaptureFixture[str]):
    path = folder / "server-1.jsonl"
    path.write_bytes(path.read_bytes().replace(b"robot-1", b"robot-2"))

    assert main(["audit", "verify", str(folder)]) == 1

    assert capsys.readouterr().out.splitlines()[1] == (
        "server-1: BROKEN in server-1.jsonl: entry 1 was changed: its hash does not match its content"
    )


def test_verify_of_a_torn_file_says_how_much_is_good(folder: Path, capsys: pytest.CaptureFixture[str]):
    path = folder / "server-1.jsonl"
    path.write_bytes(path.read_bytes()[:-10])

    assert main(["audit", "verify", str(path)]) == 1

    assert "ended in the middle of a line, 1 whole entries good" in capsys.readouterr().out


def test_a_head_stored_elsewhere_detects_truncation(folder: Path, capsys: pytest.CaptureFixture[str]):
    main(["audit", "verify", str(folder)])
    head = capsys.readouterr().out.splitlines()[1].rpartition(" ")[2]
    assert main(["audit", "verify", str(folder), "--head", f"server-1={head}"]) == 0
    path = folder / "server-1.jsonl"
    path.write_bytes(path.read_bytes().splitlines(keepends=True)[0])
    (folder / "heads").unlink()
    record_once(folder, "operator", "robot.enabled", wall_clock=lambda: 1e9 + 9)
    assert main(["audit", "verify", str(folder)]) == 0, "what is in the folder was forged"
    capsys.readouterr()

    assert main(["audit", "verify", str(folder), "--head", f"server-1={head}"]) == 1

    assert "entry 2 is missing: the head stored elsewhere has seen it" in capsys.readouterr().out


def test_show_prints_all_chains_in_the_order_of_time(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["audit", "show", str(folder)]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in lines] == ["server-1#1", "operator#1", "server-1#2"]
    assert lines[0].startswith("2001-09-09 01:46:40 server-1#1 auth.accepted robot-1 ")


def test_show_cannot_be_made_to_write_control_characters(folder: Path, capsys: pytest.CaptureFixture[str]):
    main(["audit", "show", str(folder), "--last", "1"])

    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert "\x1b" not in out
    assert r'reason="a reason\n\u001b[2J"' in out


def test_show_as_json_and_by_action(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["audit", "show", str(folder), "--only", "disabled", "--json"]) == 0

    (line,) = capsys.readouterr().out.splitlines()
    assert (json.loads(line)["log"], json.loads(line)["subject"]) == ("operator", "robot-1")
