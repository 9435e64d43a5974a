"""Files of a chain: one writer, torn ends, rotation, a full disk; and verdicts over a folder."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.chain import HEADS, Head
from rse_pf.audit.log import (
    RESERVE_BYTES,
    AuditBounds,
    AuditLog,
    chain_names,
    files_of,
    newest_head,
    record_once,
    release_reserves,
)
from rse_pf.audit.verify import check_chain, check_folder, entries_of
from rse_pf.errors import ConfigurationError


def log_in(
    folder: Path,
    who: str = "server-1",
    *,
    on_problem: Callable[[str], None] = lambda problem: None,
    **bounds: Any,
) -> AuditLog:
    chosen = AuditBounds(**{"max_bytes": 1 << 20, "sync_s": 0.001, **bounds})
    return AuditLog(folder, who, wall_clock=lambda: 1e9, bounds=chosen, on_problem=on_problem)


def write(folder: Path, n: int, who: str = "server-1", max_bytes: int = 1 << 20) -> None:
    log = log_in(folder, who, max_bytes=max_bytes).open()
    for number in range(n):
        log.record("auth.accepted", f"robot-{number}", source="10.0.0.7")
        log.flush()
    log.close()


def problem_of(folder: Path, who: str = "server-1") -> str:
    return next(verdict.problem for verdict in check_folder(folder) if verdict.who == who)


def test_a_second_run_goes_on_with_the_chain_of_the_first(tmp_path: Path):
    write(tmp_path, 3)
    write(tmp_path, 2)

    (verdict,) = check_folder(tmp_path)

    assert (verdict.entries, verdict.head.seq, verdict.problem, verdict.notes) == (5, 5, "", [])


def test_files_are_private(tmp_path: Path):
    write(tmp_path / "audit", 1)

    modes = {path.stat().st_mode & 0o777 for path in (tmp_path / "audit").iterdir()}

    assert (tmp_path / "audit").stat().st_mode & 0o777 == 0o700
    assert modes == {0o600}


def test_a_chain_runs_through_files_that_are_set_aside(tmp_path: Path):
    write(tmp_path, 40, max_bytes=2000)

    files = files_of(tmp_path, "server-1")
    (verdict,) = check_folder(tmp_path)

    assert len(files) > 5
    assert verdict.problem == ""
    assert verdict.entries == 40 + len(files) - 1
    assert files[-1].name == "server-1.jsonl"
    assert max(path.stat().st_size for path in files) < 2600


def test_a_missing_file_in_the_middle_or_at_the_beginning_is_found(tmp_path: Path):
    write(tmp_path, 40, max_bytes=2000)
    files = files_of(tmp_path, "server-1")
    kept = {path: path.read_bytes() for path in files}
    for gone in (files[2], files[0]):
        gone.unlink()
        assert "is missing or was changed" in problem_of(tmp_path)
        gone.write_bytes(kept[gone])
    assert problem_of(tmp_path) == ""


def test_a_torn_last_line_is_reported_with_the_number_of_good_entries(tmp_path: Path):
    write(tmp_path, 4)
    path = tmp_path / "server-1.jsonl"
    path.write_bytes(path.read_bytes()[:-20])

    assert problem_of(tmp_path) == "ended in the middle of a line, 3 whole entries good"


def test_the_writer_goes_on_behind_a_torn_line_and_names_the_head_it_found(tmp_path: Path):
    write(tmp_path, 4)
    path = tmp_path / "server-1.jsonl"
    torn = path.read_bytes() + b'{"action":"auth.acc'
    path.write_bytes(torn)

    write(tmp_path, 1)

    (verdict,) = check_folder(tmp_path)
    old, new = files_of(tmp_path, "server-1")
    continued = next(entries_of([new]))
    assert old.read_bytes() == torn
    assert verdict.problem == ""
    assert verdict.notes == [f"{old.name} ended in the middle of a line, 4 whole entries good"]
    assert (continued.action, continued.detail["reason"], continued.seq) == ("log.continued", "torn", 5)
    assert str(continued.detail["head"]).startswith("4:")


def test_a_torn_end_that_the_next_file_does_not_name_is_a_problem(tmp_path: Path):
    write(tmp_path, 40, max_bytes=2000)
    old = files_of(tmp_path, "server-1")[1]
    old.write_bytes(old.read_bytes() + b'{"act')

    assert "does not say that the file before it was torn" in problem_of(tmp_path)


def test_a_first_line_that_was_never_finished_is_set_aside(tmp_path: Path):
    (tmp_path / "server-1.jsonl").write_bytes(b'{"action":"auth.acc')

    write(tmp_path, 2)

    (verdict,) = check_folder(tmp_path)
    assert (verdict.problem, verdict.entries) == ("", 3)
    assert len(list(tmp_path.glob("*.torn"))) == 1


def test_a_log_with_a_changed_end_stays_broken_when_its_writer_goes_on(tmp_path: Path):
    write(tmp_path, 4)
    path = tmp_path / "server-1.jsonl"
    path.write_bytes(path.read_bytes().replace(b"robot-3", b"robot-9"))

    write(tmp_path, 2)

    assert problem_of(tmp_path) == "entry 4 was changed: its hash does not match its content"


def test_a_crash_between_two_files_leaves_a_chain_that_goes_on(tmp_path: Path):
    write(tmp_path, 4)
    (tmp_path / "server-1.jsonl").rename(tmp_path / "server-1.000000000001.jsonl")

    write(tmp_path, 1)

    (verdict,) = check_folder(tmp_path)
    assert (verdict.problem, verdict.entries) == ("", 6)


def test_one_chain_has_one_writer(tmp_path: Path):
    first = log_in(tmp_path).open()

    with pytest.raises(ConfigurationError, match="another process writes"):
        log_in(tmp_path).open()
    first.close()
    log_in(tmp_path).open().close()


def test_names_of_servers_cannot_leave_the_folder(tmp_path: Path):
    write(tmp_path / "audit", 1, who="../../etc/x y")

    assert chain_names(tmp_path / "audit") == ["______etc_x_y"]
    assert {path.name for path in tmp_path.iterdir()} == {"audit"}


def test_entries_reach_the_disk_in_the_background(tmp_path: Path):
    synced = threading.Event()
    log = AuditLog(
        tmp_path, "s", wall_clock=lambda: 1e9, bounds=AuditBounds(max_bytes=1 << 20, sync_s=0.001)
    ).open()
    real = log.flush

    def flush() -> None:
        real()
        if log.head.seq == 3:
            synced.set()

    log.flush = flush  # type: ignore[method-assign]
    log.start()
    for _ in range(3):
        log.record("x")

    assert synced.wait(10)
    log.close()
    assert check_folder(tmp_path)[0].entries == 3


def test_a_full_disk_loses_nothing_that_fits_into_memory_and_leaves_no_torn_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    problems: list[str] = []
    log = log_in(tmp_path, on_problem=problems.append).open()
    log.record("one")
    log.flush()
    real = os.write

    def full(fd: int, data: bytes) -> int:
        if len(data) > 50:
            return real(fd, bytes(data)[:50])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    for _ in range(3):
        log.record("two")
        log.flush()
    monkeypatch.undo()
    log.close()

    (verdict,) = check_folder(tmp_path)
    assert problems == ["the audit log of server-1 cannot be written: No space left on device"]
    assert [entry.action for entry in entries_of(files_of(tmp_path, "server-1"))] == ["one", *["two"] * 3]
    assert verdict.problem == ""


def test_entries_dropped_for_lack_of_memory_are_recorded_as_a_gap(tmp_path: Path):
    log = log_in(tmp_path, max_buffered=100).open()
    for _ in range(150):
        log.record("x")
    log.close()

    *_, last = entries_of(files_of(tmp_path, "server-1"))
    assert (last.action, last.detail) == ("log.gap", {"entries": 50})


def test_a_truncated_end_is_found_by_the_head_in_another_chain(tmp_path: Path):
    write(tmp_path, 5)
    control = log_in(tmp_path, "control-plane").open()
    control.record(HEADS, **{"server-1": str(newest_head(tmp_path, "server-1"))})
    control.close()
    assert [verdict.problem for verdict in check_folder(tmp_path)] == ["", ""]

    path = tmp_path / "server-1.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:3]))

    assert problem_of(tmp_path) == "entry 5 is missing: entry 1 of control-plane has seen it"
    path.unlink()
    assert problem_of(tmp_path) == "the log is missing: entry 1 of control-plane has seen entry 5"


def test_a_rewritten_chain_is_found_by_a_head_stored_elsewhere(tmp_path: Path):
    write(tmp_path, 5)
    head = newest_head(tmp_path, "server-1")
    assert head is not None
    assert check_folder(tmp_path, known={"server-1": head})[0].problem == ""
    for path in (tmp_path / "server-1.jsonl", tmp_path / "heads"):
        path.unlink()
    write(tmp_path, 7, who="server-1")
    assert problem_of(tmp_path) == "", "all that is in the folder was forged"

    (verdict,) = check_folder(tmp_path, known={"server-1": Head(head.seq, "f" * 64)})

    assert verdict.problem == "entry 5 was changed: the head stored elsewhere names another"


def test_some_files_of_a_chain_can_be_checked_alone(tmp_path: Path):
    write(tmp_path, 40, max_bytes=2000)
    some = files_of(tmp_path, "server-1")[2:4]

    verdict = check_chain("server-1", some, from_genesis=False)

    assert verdict.problem == ""
    assert verdict.notes[0].startswith("begins with entry ")


def test_record_once_writes_one_entry_and_releases_the_log(tmp_path: Path):
    for robot in ("robot-1", "robot-2"):
        record_once(tmp_path, "operator", "robot.disabled", robot, wall_clock=lambda: 1e9)

    subjects = [entry.subject for entry in entries_of(files_of(tmp_path, "operator"))]
    assert subjects == ["robot-1", "robot-2"]
    assert check_folder(tmp_path)[0].problem == ""


@pytest.mark.system
def test_a_writer_that_is_killed_leaves_a_chain_that_goes_on(tmp_path: Path):
    code = (
        "import sys, time; from pathlib import Path; from rse_pf.audit.log import AuditBounds, AuditLog\n"
        "log = AuditLog(Path(sys.argv[1]), 'server-1', wall_clock=time.time,"
        " bounds=AuditBounds(max_bytes=20000, sync_s=0.0))\n"
        "log.open().start()\n"
        "while True:\n"
        "    log.record('auth.accepted', 'robot-1')\n"
        "    if log.head.seq > 300: print(log.head.seq, flush=True)\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline()
        process.kill()
        process.wait()
        process.stdout.close()
    write(tmp_path, 1)

    (verdict,) = check_folder(tmp_path)
    assert verdict.problem == ""
    assert verdict.entries > 300


def test_on_a_full_disk_a_flood_of_refusals_leaves_the_reserve_to_what_matters_and_is_counted(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    log = log_in(folder, max_buffered=10**6).open()
    log.record("auth.accepted", "robot-1")
    log.flush()
    hog = fill(folder)
    for number in range(4000):
        log.record("auth.refused", reason="bad-signature", source="10.0.0.9")
        log.flush()
        if number % 100 == 99:
            log.record("auth.cut-off", f"robot-{number}")
            log.flush()
    assert log.waiting == 0
    hog.unlink()
    log.flush()
    log.close()

    entries = list(entries_of(files_of(folder, "server-1")))
    refused = sum(entry.action == "auth.refused" for entry in entries)
    gaps = [entry for entry in entries if entry.action == "log.gap"]
    assert sum(entry.action == "auth.cut-off" for entry in entries) == 40
    assert 100 < refused < 1000
    assert [gap.detail["entries"] for gap in gaps] == [4000 - refused]
    assert problem_of(folder) == ""


def test_entries_that_a_full_disk_lost_at_the_end_of_a_writer_are_a_gap_of_the_next(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    write(folder, 1)
    hog = fill(folder)
    log = log_in(folder).open()
    for number in range(30):
        log.record("auth.cut-off", f"robot-{number}", detail="x" * 190)
    log.close()
    assert problem_of(folder) == ""
    hog.unlink()

    write(folder, 1)

    entries = list(entries_of(files_of(folder, "server-1")))
    lost = 30 - sum(entry.action == "auth.cut-off" for entry in entries)
    assert lost > 0
    assert [entry.detail["entries"] for entry in entries if entry.action == "log.gap"] == [lost]
    assert problem_of(folder) == ""


def test_an_operator_is_told_that_an_action_could_not_be_recorded(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    folder = small_disk("4m")
    write(folder, 1)
    (folder / ".operator.lock").touch()
    (folder / "operator.jsonl").touch()
    hog = fill(folder)

    with pytest.raises(ConfigurationError, match="the disk is full"):
        record_once(folder, "operator", "robot.disabled", "robot-1", wall_clock=lambda: 1e9)
    hog.unlink()
    record_once(folder, "operator", "robot.enabled", "robot-1", wall_clock=lambda: 1e9)

    entries = [(entry.action, entry.detail) for entry in entries_of(files_of(folder, "operator"))]
    assert [action for action, _ in entries] == ["robot.enabled", "log.gap"]
    assert entries[1][1] == {"entries": 1}
    assert [verdict.problem for verdict in check_folder(folder)] == ["", ""]


def test_the_blocks_behind_the_log_of_a_killed_writer_are_given_back_and_no_other(
    small_disk: Callable[[str], Path],
):
    folder = small_disk("4m")
    code = (
        "import os, sys, time; from pathlib import Path; from rse_pf.audit.log import AuditLog\n"
        "log = AuditLog(Path(sys.argv[1]), 'killed', wall_clock=time.time).open()\n"
        "log.record('server.ready'); log.flush(); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(folder)], check=False)
    write(folder, 1, who="operator")
    log = log_in(folder, "living").open()
    log.record("server.ready")
    log.flush()

    def reserved(who: str) -> bool:
        return (folder / f"{who}.jsonl").stat().st_blocks * 512 > RESERVE_BYTES // 2

    assert all(map(reserved, ("killed", "living", "operator")))

    assert release_reserves(folder) == ["killed"]

    assert [reserved(who) for who in ("killed", "living", "operator")] == [False, True, True]
    log.close()
    assert not reserved("living"), "a writer that ends in order gives them back itself"
    assert [verdict.problem for verdict in check_folder(folder)] == [""] * 3
