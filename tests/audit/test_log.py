"""Files of an audit log: whole lines beside other writers and after a kill, rotation, a full disk."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import AuditLog, log_files, log_names, read_entries, record_once
from rse_pf.errors import ConfigurationError


def log_in(
    folder: Path, *, max_bytes: int = 1 << 20, on_problem: Callable[[str], object] = pytest.fail
) -> AuditLog:
    return AuditLog(
        folder, "server-1", wall_clock=lambda: 1e9, on_problem=on_problem, max_bytes=max_bytes
    ).open()


def write(folder: Path, subjects: range, max_bytes: int = 1 << 20) -> None:
    log = log_in(folder, max_bytes=max_bytes)
    for number in subjects:
        log.record("auth.accepted", str(number), source="10.0.0.7")
    log.close()


def entries(folder: Path, who: str = "server-1") -> list[Entry]:
    return [entry for path in log_files(folder, who) for entry in read_entries(path)]


def subjects(folder: Path) -> list[int]:
    return [int(entry.subject) for entry in entries(folder)]


def test_a_second_run_appends_to_the_log_of_the_first(tmp_path: Path):
    write(tmp_path, range(3))
    write(tmp_path, range(3, 5))

    assert subjects(tmp_path) == list(range(5))


def test_a_log_goes_on_in_a_new_file_when_one_has_grown_large(tmp_path: Path):
    write(tmp_path, range(20), max_bytes=1000)
    write(tmp_path, range(20, 40), max_bytes=1000)

    files = log_files(tmp_path, "server-1")
    assert len(files) > 3
    assert files[-1].name == "server-1.jsonl"
    assert max(path.stat().st_size for path in files) < 1200
    assert subjects(tmp_path) == list(range(40))


def test_several_writers_of_one_log_lose_nothing_when_files_are_renamed(tmp_path: Path):
    writers = [
        threading.Thread(target=write, args=(tmp_path, range(first, first + 200), 2000))
        for first in range(0, 800, 200)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()

    assert sorted(subjects(tmp_path)) == list(range(800))


@pytest.mark.parametrize("rest", [b'{"action":"auth.acc', b"{}", b"\xff"])
def test_a_line_that_a_crash_cut_hides_no_other_entry(tmp_path: Path, rest: bytes):
    write(tmp_path, range(2))
    with (tmp_path / "server-1.jsonl").open("ab") as file:
        file.write(rest)

    write(tmp_path, range(2, 4))

    assert subjects(tmp_path) == list(range(4))


def test_names_of_servers_cannot_leave_the_folder(tmp_path: Path):
    record_once(tmp_path / "audit", "../../etc/x y", "server.ready", wall_clock=lambda: 1e9)

    assert log_names(tmp_path / "audit") == ["______etc_x_y"]
    assert {path.name for path in tmp_path.iterdir()} == {"audit"}


def test_a_folder_that_cannot_be_written_is_an_error_with_a_hint(tmp_path: Path):
    (tmp_path / "file").touch()

    with pytest.raises(ConfigurationError, match="cannot write the audit log") as error:
        log_in(tmp_path / "file")
    assert "--audit" in error.value.hint


@pytest.mark.system
def test_a_writer_that_is_killed_leaves_whole_lines(tmp_path: Path):
    code = (
        "import sys, time; from pathlib import Path; from rse_pf.audit.log import AuditLog\n"
        "log = AuditLog(Path(sys.argv[1]), 'server-1', wall_clock=time.time, on_problem=print,\n"
        "    max_bytes=20000).open()\n"
        "for number in range(10**6):\n"
        "    log.record('auth.accepted', str(number)); log.flush()\n"
        "    if number == 300: print(flush=True)\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline()
        process.kill()
        process.wait()
        process.stdout.close()

    found = subjects(tmp_path)
    runs = [at for at, number in enumerate(found) if number == 0] + [len(found)]
    assert len(runs) == 4
    for begin, end in pairwise(runs):
        assert found[begin:end] == list(range(end - begin))
        assert end - begin > 300


def test_entries_wait_in_memory_while_the_disk_is_full_and_those_beyond_the_limit_are_counted(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    problems: list[str] = []
    log = log_in(folder, on_problem=problems.append)
    hog = fill(folder)
    for number in range(20_100):
        log.record("auth.cut-off", str(number))
    is_written = log.flush()
    hog.unlink()
    log.close()

    *written, gap = entries(folder)
    assert not is_written
    assert problems == ["the audit log of server-1 cannot be written: No space left on device"]
    assert [int(entry.subject) for entry in written] == list(range(20_000))
    assert (gap.action, gap.detail) == ("log.gap", {"entries": 100})


def test_a_log_that_is_closed_on_a_full_disk_says_how_many_entries_it_lacks(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    problems: list[str] = []
    log = log_in(folder, on_problem=problems.append)
    fill(folder)
    for number in range(200):
        log.record("auth.cut-off", str(number), source="10.0.0.7")

    assert not log.close()
    lacks = 200 - len(entries(folder))
    assert lacks > 0
    assert problems == [
        "the audit log of server-1 cannot be written: No space left on device",
        f"the audit log of server-1 ends without its last {lacks} entries",
    ]


def test_entries_wait_while_the_disk_does_not_confirm_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    problems: list[str] = []
    log = log_in(tmp_path, on_problem=problems.append)

    def fail(fd: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    for number in range(3):
        log.record("auth.accepted", str(number))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        assert not log.flush()
    (tmp_path / "server-1.jsonl").write_bytes(b"")  # as a machine that fails leaves it

    assert log.close()
    assert subjects(tmp_path) == [0, 1, 2]
    assert problems == ["the audit log of server-1 cannot be written: Input/output error"]


def test_an_action_that_could_not_be_recorded_is_an_error(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    record_once(folder, "operator", "robot.enabled", "x" * 150, wall_clock=lambda: 1e9)
    fill(folder)

    def record_many() -> None:
        for _ in range(100):  # the last block of the file has space for some
            record_once(folder, "operator", "robot.disabled", "x" * 150, wall_clock=lambda: 1e9)

    with pytest.raises(ConfigurationError, match="No space left on device"):
        record_many()


def test_files_are_private(tmp_path: Path):
    write(tmp_path / "audit", range(1))

    assert (tmp_path / "audit").stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "audit").iterdir()} == {0o600}
