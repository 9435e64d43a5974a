"""A process is its pid and the time it began; nobody else is ever signalled."""

from __future__ import annotations

import dataclasses
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.local.processes import (
    ProcessMark,
    is_alive,
    mark_of,
    remove_old_logs,
    rotate_long_logs,
    send_signal,
    spawn,
    wait_ended,
)

pytestmark = pytest.mark.system

SOON_S = 10.0
WAIT_FOR_EVER = "import signal; signal.pause()"


@pytest.fixture
def child() -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-c", WAIT_FOR_EVER]) as process:
        yield process
        process.kill()


def marked(process: subprocess.Popen[bytes]) -> ProcessMark:
    mark = mark_of(process.pid)
    assert mark is not None
    return mark


def test_a_process_that_re_uses_the_pid_is_not_signalled(child: subprocess.Popen[bytes]) -> None:
    earlier = dataclasses.replace(marked(child), began="1@another-boot")

    assert not is_alive(earlier)
    assert not send_signal(earlier, signal.SIGKILL)
    assert wait_ended(earlier, 0.0)
    assert child.poll() is None


@pytest.mark.parametrize("dies", [True, False])
def test_ctrl_c_does_not_reach_a_spawned_process_and_its_niceness_counts(tmp_path: Path, dies: bool) -> None:
    """A group of its own for the first, our session for the second: Linux may share time out by session."""
    log = tmp_path / "log"
    told = "import os; print(os.getpgid(0) == os.getpid(), os.getsid(0), flush=True)"
    spawn([sys.executable, "-c", told], log=log, folder=tmp_path, dies_with_parent=dies).wait()

    assert log.read_text().split() == ["True", str(os.getsid(0))]


def test_a_spawned_process_may_open_as_many_files_as_the_system_allows(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, 512), hard))
    try:
        process = spawn(
            [sys.executable, "-c", WAIT_FOR_EVER],
            log=tmp_path / "log",
            folder=tmp_path,
            dies_with_parent=True,
        )
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    try:
        assert resource.prlimit(process.pid, resource.RLIMIT_NOFILE) == (hard, hard)
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("dies", [True, False])
def test_a_process_dies_with_its_parent_only_if_told_to(tmp_path: Path, dies: bool) -> None:
    parent = f"""
import signal, sys
from pathlib import Path
from rse_pf.local.processes import spawn
command = [sys.executable, "-c", {WAIT_FOR_EVER!r}]
child = spawn(command, log=Path("log"), folder=Path("."), dies_with_parent={dies})
print(child.pid, flush=True)
signal.pause()
"""
    with subprocess.Popen([sys.executable, "-c", parent], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        mark = mark_of(int(process.stdout.readline()))
        assert mark is not None
        process.kill()

    if dies:
        assert wait_ended(mark, SOON_S)
    else:
        assert is_alive(mark)
        send_signal(mark, signal.SIGKILL)
        assert wait_ended(mark, SOON_S)


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_predecessor_is_as_private_as_the_log(tmp_path: Path, mode: int) -> None:
    log = tmp_path / "server-1.log"
    log.write_text("x" * 200)
    log.chmod(mode)
    rotate_long_logs(tmp_path, 100)

    assert (tmp_path / "server-1.log.1").stat().st_mode & 0o777 == mode


def test_the_oldest_logs_of_ended_processes_are_removed_and_nothing_else(tmp_path: Path) -> None:
    for number in range(6):
        log = tmp_path / f"server-{number}.log"
        log.write_text("x" * 100)
        os.utime(log, (number, number))
    audit = tmp_path / "server-0.000000000001.jsonl"
    audit.write_text("{}")

    removed = remove_old_logs(tmp_path, ["server-0"], max_logs=4, max_bytes=1000)
    longest = remove_old_logs(tmp_path, ["server-0"], max_logs=4, max_bytes=250)

    assert [path.name for path in removed] == ["server-1.log"]
    assert [path.name for path in longest] == ["server-3.log", "server-2.log"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        audit.name, "server-0.log", "server-4.log", "server-5.log",
    ]  # fmt: skip


_PARENT_OF_ORPHANS = """
import asyncio, sys
from pathlib import Path
from rse_pf.processes.linux import PR_SET_CHILD_SUBREAPER, prctl
from rse_pf.local.processes import reap_orphans, spawn

async def main() -> None:
    prctl(PR_SET_CHILD_SUBREAPER, 1)
    here = Path(sys.argv[1])
    reaper = asyncio.ensure_future(reap_orphans())
    child = spawn(["sh", "-c", "sleep 0.1 & echo $! > orphan; exit 7"], log=here / "log", folder=here,
                  dies_with_parent=True)
    while not (here / "orphan").exists() or not (here / "orphan").read_text():
        await asyncio.sleep(0.01)
    orphan = Path("/proc") / (here / "orphan").read_text().strip()
    while orphan.exists():
        await asyncio.sleep(0.05)
    print(child.wait())
    reaper.cancel()

asyncio.run(main())
"""


def test_a_process_without_an_init_reaps_orphans_and_no_child_that_it_holds(tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", _PARENT_OF_ORPHANS, str(tmp_path)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip

    assert (ended.stdout, ended.stderr) == ("7\n", "")
