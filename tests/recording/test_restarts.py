"""A recorder that exited is replaced, a bounded number of times, and workers continue with the new one."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.recording.recorder_process import RecorderPlan
from rse_pf.extensions.recording.server_recorder import FileServerRecorder
from rse_pf.extensions.recording.tap import LOST, OPENED, UP, PipeEntry, PipeReader, RecordingTap, send_pipe
from rse_pf.identity import RobotId

ROBOT = RobotId("default", "robot-1")
_DEADLINE_S = 10.0


class FakeProcess:
    """A recorder that ends when it is reported to."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.code = 0
        self._ended = threading.Event()

    def end(self, code: int) -> None:
        self.code = code
        self._ended.set()

    def wait(self) -> int:
        assert self._ended.wait(_DEADLINE_S)
        return self.code


class FakeRecorders:
    """Starts recorders, and tells of them."""

    def __init__(self) -> None:
        self.plans: list[RecorderPlan] = []
        self.keys: set[bytes] = set()
        self.processes: list[FakeProcess] = []
        self._started = threading.Condition()

    def start(self, plan: RecorderPlan, key: bytes) -> FakeProcess:
        with self._started:
            self.plans.append(plan)
            self.keys.add(key)
            self.processes.append(FakeProcess(100 + len(self.plans)))
            self._started.notify_all()
            return self.processes[-1]

    def wait_for(self, count: int) -> FakeProcess:
        with self._started:
            assert self._started.wait_for(lambda: len(self.processes) >= count, _DEADLINE_S)
            return self.processes[count - 1]


def recording(folder: Path, recorders: FakeRecorders) -> FileServerRecorder:
    settings = PlatformSettings().replace(recording={"folder": str(folder)})
    return FileServerRecorder(settings, "server-1", start=recorders.start, restart_s=0.0, clock=lambda: 1.0)


def test_a_recorder_that_is_killed_is_started_again_five_times_with_the_same_key(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    recorders = FakeRecorders()

    with recording(tmp_path, recorders) as recorded:
        assert recorded.to_recorder is not None
        worker = os.dup(recorded.to_recorder)
        recorded.leave_to_workers()
        for count in range(1, 7):
            recorders.wait_for(count).end(-9)
        watching = next(each for each in threading.enumerate() if each.name == "recorder")
        watching.join(_DEADLINE_S)
        is_over = send_pipe(worker)
    os.close(worker)

    assert [each.restarts for each in recorders.plans] == [0, 1, 2, 3, 4, 5]
    assert len(recorders.keys) == 1
    assert is_over is None
    assert recorded.pids == []
    events = [json.loads(line)["event"] for line in capfd.readouterr().err.splitlines()]
    assert events == ["recorder-restarted"] * 5 + ["recorder-given-up"]


def entries(end: int) -> list[PipeEntry]:
    return list(PipeReader().entries(os.read(end, 1 << 20)))


def test_the_next_recorder_learns_of_open_connections_and_gets_what_waited():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    due: list[Callable[[], None]] = []
    first = send_pipe(theirs.fileno())
    assert first is not None
    tap = RecordingTap(
        first, call_later=lambda seconds, call: due.append(call), renew=lambda: send_pipe(theirs.fileno())
    )
    kept, gone = tap.open_connection("bin", ROBOT), tap.open_connection("zlib", ROBOT)
    _, (end,), _, _ = socket.recv_fds(ours, 1, 4)
    due.pop()()
    assert [each.kind for each in entries(end)] == [OPENED, OPENED]
    tap.close_connection(gone)
    tap.observe_received(kept, b"asks")
    os.close(end)

    due.pop()()  # finds that nobody reads, and has another pipe
    tap.observe_received(kept, b"asks again")
    late = tap.open_connection("bin", ROBOT)
    due.pop()()

    _, (end,), _, _ = socket.recv_fds(ours, 1, 4)
    found = entries(end)
    assert [(each.kind, each.connection) for each in found] == [
        (OPENED, kept), (UP, kept), (OPENED, late), (LOST, 0)
    ]  # fmt: skip
    assert json.loads(found[0].data) == ["bin", *ROBOT]
    assert found[1].data == b"asks again"
    assert tap.dropped == 1
    assert not tap.is_dead
    tap.flush()
    os.close(end)
    theirs.close()
    ours.close()
