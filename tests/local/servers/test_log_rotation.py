"""A local platform that runs for weeks does not fill the disk with its logs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rse_pf.local.processes import spawn
from rse_pf.local.servers.log_rotation import rotate_long_logs


def test_a_long_log_begins_anew_and_its_lines_stay_in_its_predecessor(tmp_path: Path) -> None:
    long, short, other = (tmp_path / name for name in ("server-1.log", "server-2.log", "settings.json"))
    long.write_text("old\n" * 100)
    short.write_text("few\n")
    other.write_text("x" * 1000)

    assert rotate_long_logs(tmp_path, 100) == [long]

    assert long.read_text() == ""
    assert (tmp_path / "server-1.log.1").read_text() == "old\n" * 100
    assert (short.read_text(), len(other.read_text())) == ("few\n", 1000)
    assert rotate_long_logs(tmp_path, 100) == []


def test_a_predecessor_is_replaced_so_that_two_files_are_all(tmp_path: Path) -> None:
    log = tmp_path / "server-1.log"
    for word in ("first", "second", "third"):
        log.write_text(word * 50)
        rotate_long_logs(tmp_path, 100)

    assert sorted(path.name for path in tmp_path.iterdir()) == ["server-1.log", "server-1.log.1"]
    assert (tmp_path / "server-1.log.1").read_text() == "third" * 50


@pytest.mark.system
def test_a_process_goes_on_writing_at_the_new_beginning(tmp_path: Path) -> None:
    """Its descriptor appends: else the file would begin with a hole as long as what was cut off."""
    log, go = tmp_path / "server-1.log", tmp_path / "go"
    told = (
        "import os, time; print('x' * 500, flush=True)\n"
        "open('wrote', 'w').close()\n"
        "while not os.path.exists('go'): time.sleep(0.01)\n"
        "print('after', flush=True)"
    )
    process: subprocess.Popen[bytes] = spawn(
        [sys.executable, "-c", told], log=log, folder=tmp_path, dies_with_parent=True
    )
    while not (tmp_path / "wrote").exists():
        assert process.poll() is None
    rotate_long_logs(tmp_path, 100)
    go.touch()
    assert process.wait(10) == 0

    assert log.read_bytes() == b"after\n"


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_predecessor_is_as_private_as_the_log(tmp_path: Path, mode: int) -> None:
    log = tmp_path / "server-1.log"
    log.write_text("x" * 200)
    log.chmod(mode)
    rotate_long_logs(tmp_path, 100)

    assert (tmp_path / "server-1.log.1").stat().st_mode & 0o777 == mode
