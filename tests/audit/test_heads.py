"""The heads of all chains: a cut end, a removed log and a copy of a log are named, whichever log it is."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf.audit.chain import GENESIS, HEADS, Head
from rse_pf.audit.heads import HeadsFile, read_heads, write_heads
from rse_pf.audit.log import (
    AuditBounds,
    AuditLog,
    chain_names,
    files_of,
    grown_heads,
    newest_head,
    record_once,
)
from rse_pf.audit.verify import check_folder, entries_of

WRITERS = ("control-plane", "data", "operator", "server-1")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The logs of four writers with five entries each; their files are set aside after some entries."""
    for who in WRITERS:
        write(tmp_path, who, 5)
    assert problems(tmp_path) == {}
    return tmp_path


def write(folder: Path, who: str, n: int) -> None:
    log = AuditLog(
        folder, who, wall_clock=lambda: 1e9, bounds=AuditBounds(max_bytes=700, sync_s=0.001)
    ).open()
    for number in range(n):
        log.record("auth.accepted", f"robot-{number}")
        log.flush()
    log.close()


def problems(folder: Path) -> dict[str, str]:
    return {each.who: each.problem for each in check_folder(folder) if each.problem}


def cut(folder: Path, who: str, count: int) -> None:
    """Remove the last *count* entries of a chain."""
    for path in reversed(files_of(folder, who)):
        lines = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(lines[: max(0, len(lines) - count)]))
        count -= len(lines)
        if count <= 0:
            return


@pytest.mark.parametrize("who", WRITERS)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_cut_end_of_any_log_is_named(folder: Path, who: str, count: int) -> None:
    head = newest_head(folder, who)
    assert head is not None

    cut(folder, who, count)

    assert problems(folder) == {who: f"entry {head.seq} is missing: the file of heads has seen it"}


@pytest.mark.parametrize("who", WRITERS)
def test_a_cut_end_stays_named_when_the_writer_goes_on(folder: Path, who: str) -> None:
    head = newest_head(folder, who)
    assert head is not None
    cut(folder, who, 2)

    for _ in range(2):
        write(folder, who, 8)

    assert list(problems(folder)) == [who]
    assert problems(folder)[who].startswith(f"entry {head.seq} was changed: entry ")
    assert problems(folder)[who].endswith(f" of {who} names another")


def test_a_lost_last_entry_is_named_although_another_one_has_its_number(tmp_path: Path) -> None:
    write(tmp_path, "server-1", 1)
    path = tmp_path / "server-1.jsonl"
    path.write_bytes(b'{"action":"auth.acc')

    write(tmp_path, "server-1", 1)

    assert problems(tmp_path) == {"server-1": "entry 1 was changed: entry 2 of server-1 names another"}


@pytest.mark.parametrize("who", WRITERS)
def test_a_removed_log_is_named_before_and_after_its_writer_begins_anew(folder: Path, who: str) -> None:
    for path in files_of(folder, who):
        path.unlink()
    assert list(problems(folder)) == [who]
    assert problems(folder)[who].startswith("the log is missing: the file of heads has seen entry")

    write(folder, who, 20)

    assert "was changed: entry 1 of" in problems(folder)[who]


@pytest.mark.parametrize("copied", ["server-9", "aaa"])
def test_a_copy_of_a_log_under_a_new_name_is_named(folder: Path, copied: str) -> None:
    for path in files_of(folder, "server-1"):
        shutil.copy(path, path.with_name(path.name.replace("server-1", copied)))

    assert problems(folder) == {copied: "the log was added: its entries are a copy of those of server-1"}


def test_a_copy_over_the_log_of_another_writer_is_named(folder: Path) -> None:
    for path in files_of(folder, "data"):
        path.unlink()
    for path in files_of(folder, "server-1"):
        shutil.copy(path, path.with_name(path.name.replace("server-1", "data")))

    assert problems(folder) == {"data": "the log was added: its entries are a copy of those of server-1"}


def test_a_log_from_another_platform_is_named(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    write(elsewhere, "server-7", 3)

    for path in files_of(elsewhere, "server-7"):
        shutil.copy(path, folder)

    assert problems(folder) == {"server-7": "the log was added: it has no line in the file of heads"}


def _remove(path: Path) -> None:
    path.unlink()


def _spoil(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"data ", b"data x"))


def _repeat(path: Path) -> None:
    path.write_bytes(path.read_bytes() * 2)


@pytest.mark.parametrize("change", [_remove, _spoil, _repeat])
def test_a_changed_or_removed_file_of_heads_is_named(folder: Path, change: Callable[[Path], None]) -> None:
    change(folder / "heads")

    assert "heads" in problems(folder)


def test_an_older_file_of_heads_is_no_problem_because_a_crash_leaves_one(tmp_path: Path) -> None:
    write(tmp_path, "server-1", 2)
    old = (tmp_path / "heads").read_bytes()
    write(tmp_path, "server-1", 2)

    (tmp_path / "heads").write_bytes(old)

    assert problems(tmp_path) == {}


def test_a_lost_file_of_heads_is_made_for_all_logs_and_noted(folder: Path) -> None:
    (folder / "heads").unlink()

    write(folder, "operator", 1)

    assert problems(folder) == {}
    (noted,) = [each.who for each in check_folder(folder) if any("was missing" in n for n in each.notes)]
    assert noted == "operator"
    cut(folder, "server-1", 1)
    assert list(problems(folder)) == ["server-1"]


@pytest.mark.parametrize("loss", [Path.unlink, lambda path: path.write_bytes(b"")])
def test_a_writer_that_runs_makes_a_lost_file_again_with_what_it_wrote(
    tmp_path: Path, loss: Callable[[Path], object]
) -> None:
    log = AuditLog(tmp_path, "server-1", wall_clock=lambda: 1e9).open()
    for _ in range(2):
        log.record("auth.accepted")
        log.flush()
    loss(tmp_path / "heads")
    path = tmp_path / "server-1.jsonl"
    path.write_bytes(path.read_bytes().splitlines(keepends=True)[0])

    log.record("auth.accepted")
    log.close()

    assert read_heads(tmp_path) == ({"server-1": log.head}, [])
    assert problems(tmp_path)["server-1"].startswith("entry 2 is missing")


def test_the_first_writer_of_a_folder_loses_nothing(tmp_path: Path) -> None:
    write(tmp_path, "server-1", 1)

    assert [entry.action for entry in entries_of(files_of(tmp_path, "server-1"))] == ["auth.accepted"]


def test_many_writers_at_once_have_a_line_each(tmp_path: Path) -> None:
    names = [f"server-{number}" for number in range(12)]
    threads = [threading.Thread(target=write, args=(tmp_path, name, 4)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert problems(tmp_path) == {}
    kept = read_heads(tmp_path)
    assert kept is not None
    assert kept[0] == {name: newest_head(tmp_path, name) for name in names}
    assert chain_names(tmp_path) == sorted(names)


def test_a_writer_that_runs_records_the_heads_of_the_control_plane_and_of_operators(tmp_path: Path) -> None:
    for who in ("control-plane", "operator", "server-2"):
        record_once(tmp_path, who, "x", wall_clock=lambda: 1e9)
    log = AuditLog(
        tmp_path, "server-1", wall_clock=lambda: 1e9, bounds=AuditBounds(sync_s=0.001, heads_s=0.001)
    ).open()
    told = threading.Event()
    real = log.flush

    def flush() -> None:
        real()
        if log.head.seq:
            told.set()

    log.flush = flush  # type: ignore[method-assign]
    log.start()
    assert told.wait(10)
    log.close()

    entries = list(entries_of(files_of(tmp_path, "server-1")))
    assert [(entry.action, sorted(entry.detail)) for entry in entries] == [
        ("log.heads", ["control-plane", "operator"])
    ], "heads that did not grow are not recorded again"
    (tmp_path / "heads").unlink()
    record_once(tmp_path, "server-2", "x", wall_clock=lambda: 1e9)
    cut(tmp_path, "operator", 1)
    assert problems(tmp_path) == {"operator": "the log is missing: entry 1 of server-1 has seen entry 1"}


def test_entries_that_hold_only_heads_are_not_answered_with_heads(tmp_path: Path) -> None:
    recorded: dict[str, str] = {}
    record_once(tmp_path, "operator", "x", wall_clock=lambda: 1e9)
    first = newest_head(tmp_path, "operator")
    assert grown_heads(tmp_path, ["operator"], recorded) == {"operator": str(first)}

    record_once(tmp_path, "operator", HEADS, wall_clock=lambda: 1e9, data=str(first))
    assert grown_heads(tmp_path, ["operator"], recorded) == {}

    record_once(tmp_path, "operator", "x", wall_clock=lambda: 1e9)
    assert grown_heads(tmp_path, ["operator"], recorded) == {
        "operator": str(newest_head(tmp_path, "operator"))
    }


def test_a_line_never_crosses_a_page_and_reads_as_it_was_written(tmp_path: Path) -> None:
    heads = {f"{'w' * 63}{number}": Head(10**14 + number, "f" * 64) for number in range(9)}

    write_heads(tmp_path, heads)

    assert read_heads(tmp_path) == (heads, [])
    assert 4096 % ((tmp_path / "heads").stat().st_size // 9) == 0
    file = HeadsFile(tmp_path, f"{'w' * 63}4", dict)
    assert file.open() == (heads[f"{'w' * 63}4"], False)
    file.close()
    newcomer = HeadsFile(tmp_path, "new", dict)
    assert newcomer.open() == (GENESIS, False)
    newcomer.close()
