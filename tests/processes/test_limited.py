"""Processes with limits: every way to end one costs that process, one typed error, and nothing else."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from rse_pf.errors import BadRequest, Busy, Crashed, Expired, InternalError, RsePfError, WorkerLost
from rse_pf.processes.limited import LimitedProcesses, Overran, ProcessLimits

_HANDLER = '''
import os, resource, signal, socket, time
from pathlib import Path
from rse_pf.processes.limited import limit_cpu
from rse_pf.errors import BadRequest
from rse_pf.processes.linux import prctl

def make(configuration):
    """Return a handler that does what it is told."""
    kept = []

    def handle(data):
        word, _, rest = data.decode().partition(" ")
        if word == "pid":
            return str(os.getpid()).encode()
        if word == "configuration":
            return configuration.encode()
        if word == "size":
            return str(len(rest)).encode()
        if word == "lists":
            kept.append([bytearray(16_384) for _ in range(1_000_000)])
        if word == "keep":
            kept.append(bytearray(int(rest)))
        if word == "signal":
            os.kill(os.getpid(), int(rest))
        if word == "less":
            limit_cpu(0.05)
            word = "loop"
        if word == "burn":
            end = time.process_time() + float(rest)
            while time.process_time() < end:
                pass
        if word == "loop":
            while True:
                pass
        if word == "sleep":
            prctl(15, b"sleeping")
            time.sleep(60)
        if word == "refuse":
            raise BadRequest("no", hint="ask for less", retry_after_ms=5.0)
        if word == "defect":
            raise ZeroDivisionError("secret")
        if word == "print":
            os.write(1, b"what a library prints\\n")
            os.write(2, b"what a library prints\\n")
        if word == "exit":
            raise SystemExit(3)
        if word == "long":
            return bytes(int(rest))
        if word == "limits":
            core = resource.getrlimit(resource.RLIMIT_CORE)
            score = Path("/proc/self/oom_score_adj").read_text().strip()
            threads = len(os.listdir("/proc/self/task"))
            return repr((core, score, threads, os.nice(0))).encode()
        if word == "descriptors":
            return "\\n".join(os.readlink(f"/proc/self/fd/{fd}").split(":")[0] for fd in fds()).encode()
        return b"done"

    return handle

def fds():
    with os.scandir("/proc/self/fd") as entries:
        names = [entry.name for entry in entries]
    return [name for name in names if os.path.lexists(f"/proc/self/fd/{name}")]

def broken(configuration):
    raise RuntimeError("it cannot start")
'''
MEMORY_BYTES = 64 << 20
LONG_S = 20.0


@pytest.fixture(scope="module")
def handler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The name of a target that the template can import."""
    folder = tmp_path_factory.mktemp("handler")
    (folder / "handled_in_tests.py").write_text(_HANDLER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder))
        yield "handled_in_tests:make"


def made_of(handler: str, count: int = 1) -> LimitedProcesses:
    return LimitedProcesses(
        handler, ProcessLimits(memory_bytes=MEMORY_BYTES, cpu_s=0.3), configuration="chosen", count=count
    )


@pytest.fixture(scope="module")
def processes(handler: str) -> Iterator[LimitedProcesses]:
    """Processes whose template has started; most tests share them."""
    with made_of(handler) as made:
        made.call(b"", LONG_S)
        yield made


@pytest.fixture
def own(handler: str) -> Iterator[LimitedProcesses]:
    """Processes of one test, not started yet."""
    with made_of(handler) as made:
        yield made


def state_of(pid: int) -> str:
    """Return the state of a process as the kernel names it, "" if it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def is_working(pid: int) -> bool:
    """Whether the handler of *pid* sleeps, for which it takes that name."""
    return Path(f"/proc/{pid}/comm").read_text() == "sleeping\n"


def has_ended(pid: int, within_s: float = 10.0) -> bool:
    """Wait until a process has ended, whether its parent has reaped it or not."""
    until = time.monotonic() + within_s
    while state_of(pid) not in ("", "Z") and time.monotonic() < until:
        threading.Event().wait(0.005)
    return state_of(pid) in ("", "Z")


@contextmanager
def beside(call: Callable[[], object], error: type[RsePfError]) -> Iterator[threading.Thread]:
    """Run a call that raises *error* in a thread, while the block runs."""
    raised: list[BaseException] = []

    def work() -> None:
        try:
            call()
        except error as caught:
            raised.append(caught)

    thread = threading.Thread(target=work)
    thread.start()
    yield thread
    thread.join(LONG_S)
    assert len(raised) == 1


def test_a_call_gets_the_process_that_had_one_like_it(handler: str):
    with made_of(handler, count=2) as made:
        first = int(made.call(b"pid", LONG_S))
        with beside(lambda: made.call(b"sleep", 2.0), Overran):
            while not is_working(first):
                threading.Event().wait(0.005)
            of_rooms = made.call(b"pid", LONG_S, near="rooms")
        of_kitchen = made.call(b"pid", LONG_S, near="kitchen")
        assert of_kitchen != of_rooms
        for _ in range(3):
            assert made.call(b"pid", LONG_S, near="rooms") == of_rooms
            assert made.call(b"pid", LONG_S, near="kitchen") == of_kitchen


@pytest.mark.parametrize(
    ("data", "error", "times"), [(b"burn 0.1", None, 1), (b"refuse", BadRequest, 1), (b"loop", Crashed, 1),
                                 (b"signal 9", Crashed, 2)],
)  # fmt: skip
def test_a_call_is_charged_for_the_cpu_time_of_each_process_that_worked_on_it(
    processes: LimitedProcesses, data: bytes, error: type[RsePfError] | None, times: int
):
    call_s: list[float] = []
    processes.call(b"", LONG_S)

    with nullcontext() if error is None else pytest.raises(error):
        processes.call(data, LONG_S, charge=call_s.append)

    assert len(call_s) == times
    # The limit of 0.3 s, which ends the loop, includes what its process took to start: at most 0.1 s.
    least_s, most_s = {b"burn 0.1": (0.09, 0.2), b"loop": (0.2, 0.4)}.get(data, (0.0, 0.1))
    assert least_s <= sum(call_s) < most_s


def test_a_process_has_its_limits(processes: LimitedProcesses):
    told = processes.call(b"limits", LONG_S)

    assert told.decode() == repr(((0, 0), "1000", 1, min(19, os.nice(0) + 5)))


def test_a_process_has_one_socket_and_the_log_and_nothing_of_its_owner_or_siblings(handler: str):
    with made_of(handler, count=2) as made, beside(lambda: made.call(b"sleep", 2.0), Overran):
        first = made.pids()[1:]
        while not (first and is_working(first[0])):
            threading.Event().wait(0.005)
            first = made.pids()[1:]
        held = made.call(b"descriptors", LONG_S).decode().splitlines()

    assert (held.count("socket"), held.count("anon_inode"), len(held)) == (1, 0, 5), held


@pytest.mark.parametrize(
    ("data", "how"),
    [
        (b"lists", "67 MB"),
        (b"keep 100000000", "67 MB"),
        (b"signal 11", "SIGSEGV"),
        (b"signal 6", "SIGABRT"),
        (b"signal 9", "SIGKILL"),
        (b"loop", r"used 0\.[2-5] s of CPU"),
        (b"less", r"used 0\.[01] s of CPU"),
        (b"long 2000000", "2000000 bytes"),
    ],
)
def test_bytes_that_end_their_process_are_crashed_and_the_next_call_is_answered(
    processes: LimitedProcesses, data: bytes, how: str
):
    with pytest.raises(Crashed, match=how):
        processes.call(data, LONG_S)

    assert processes.call(b"", 5.0) == b"done"


def test_a_call_that_sleeps_is_killed_at_its_timeout(processes: LimitedProcesses):
    pid = int(processes.call(b"pid", LONG_S))
    began = time.monotonic()

    with pytest.raises(Overran) as raised:
        processes.call(b"sleep", 0.1)

    assert raised.value.cpu_s < 0.05
    assert time.monotonic() - began < 5.0
    assert state_of(pid) == ""


def test_what_the_handler_refuses_arrives_with_its_hint(processes: LimitedProcesses):
    pid = processes.call(b"pid", LONG_S)

    with pytest.raises(BadRequest) as raised:
        processes.call(b"refuse", LONG_S)

    assert (raised.value.message, raised.value.hint, raised.value.retry_after_ms) == (
        "no",
        "ask for less",
        5.0,
    )
    assert processes.call(b"pid", LONG_S) == pid


@pytest.mark.parametrize("data", [b"defect", b"exit"])
def test_a_defect_of_the_handler_is_internal_and_goes_to_the_log(
    own: LimitedProcesses, capfd: pytest.CaptureFixture[str], data: bytes
):
    with pytest.raises(InternalError) as raised:
        own.call(data, LONG_S)

    assert "secret" not in raised.value.message
    assert "Traceback" in capfd.readouterr().err


def test_what_libraries_print_does_not_reach_the_log(
    own: LimitedProcesses, capfd: pytest.CaptureFixture[str]
):
    assert own.call(b"print", LONG_S) == b"done"

    with pytest.raises(InternalError):
        own.call(b"defect", LONG_S)
    log = capfd.readouterr()
    assert "library" not in log.out + log.err
    assert "Traceback" in log.err


def test_a_hundred_kills_leave_no_process_and_no_descriptor(processes: LimitedProcesses):
    processes.call(b"", LONG_S)
    template = processes.pids()[0]

    def held() -> tuple[int, int]:
        children = Path(f"/proc/{template}/task/{template}/children").read_text().split()
        theirs = len(os.listdir(f"/proc/{template}/fd"))
        return len(os.listdir("/proc/self/fd")) + theirs, len(children)

    before = held()
    for _ in range(100):
        with pytest.raises(Crashed):
            processes.call(b"signal 9", LONG_S)
    processes.call(b"", LONG_S)

    assert held() == before
    assert len(processes.pids()) == 2


def test_without_a_free_process_in_time_a_call_is_busy(processes: LimitedProcesses):
    processes.call(b"", LONG_S)
    refused: list[RsePfError] = []
    with beside(lambda: processes.call(b"sleep", 0.3), Expired) as thread:
        while thread.is_alive():
            try:
                processes.call(b"", 0.01)
            except (Busy, Expired) as error:
                refused.append(error)

    assert any(isinstance(error, Busy) for error in refused)


def test_closing_ends_all_processes_and_the_calls_that_are_under_way(own: LimitedProcesses):
    own.call(b"", LONG_S)
    pids = own.pids()
    with beside(lambda: own.call(b"sleep", LONG_S), WorkerLost):
        while state_of(pids[1]) and not is_working(pids[1]):
            threading.Event().wait(0.001)
        own.close()

    assert state_of(pids[0]) == ""
    assert has_ended(pids[1])
    with pytest.raises(WorkerLost):
        own.call(b"", LONG_S)
