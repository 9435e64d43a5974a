"""Idle job servers compute parts of a batch that invites them, and leave when a job waits."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import msgspec
import pytest

from rse_pf.batch.cluster import ClusterKey, DaskEngine, LocalCluster, new_cluster_key
from rse_pf.batch.helpers import BatchHelpers
from rse_pf.batch.invitation import EXPIRES_S, Invitation, Invited, invitations
from rse_pf.batch.parts import Part, PartResult, put_input, read_result
from rse_pf.batch.tasks import graph_arrays
from rse_pf.config import PlatformSettings
from rse_pf.object_store import DirectoryStore, MemoryStore
from tests.synthetic_maps import make_sphere

pytest.importorskip("distributed", reason="the extra batch is not installed")


def test_nobody_helps_without_an_invitation() -> None:
    helpers = BatchHelpers(MemoryStore(), 2)

    helpers.step(may_help=True)

    assert helpers.pids == []


def test_nobody_helps_while_jobs_run() -> None:
    store = MemoryStore()
    Invitation(store, ClusterKey("certificate", "pem"), name="one").announce("tls://127.0.0.1:1")
    helpers = BatchHelpers(store, 2)

    helpers.step(may_help=False)

    assert helpers.pids == []


class FakeWorker:
    """A process that runs until it ends."""

    pid = 1

    def __init__(self) -> None:
        self.code: int | None = None

    def exit_code(self) -> int | None:
        return self.code

    def kill(self) -> None:
        self.code = -9


class Machine:
    """A job server of one slot, its time, and the addresses of the schedulers that its workers joined."""

    def __init__(self, store: MemoryStore, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        self.joined: list[str] = []
        self.workers: list[FakeWorker] = []
        self.helpers = BatchHelpers(store, 1, clock=lambda: self.now_s)
        monkeypatch.setattr("rse_pf.batch.helpers.start_worker", self._start)

    def _start(self, certificate: str, key: str, address: str, **_: object) -> FakeWorker:
        self.joined.append(address)
        self.workers.append(FakeWorker())
        return self.workers[-1]

    def step(self, after_s: float = 0.0) -> int:
        self.now_s += after_s
        self.helpers.step(may_help=True)
        return len(self.helpers.pids)


def invite(store: MemoryStore, name: str, beat: int = 0) -> None:
    invited = Invited(address=name, certificate="certificate", key="pem", beat=beat)
    store.put(f"batch/schedulers/{name}", msgspec.json.encode(invited))


def test_a_batch_whose_process_ended_without_a_word_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    store = MemoryStore()
    machine = Machine(store, monkeypatch)
    for beat in range(10):
        invite(store, "one", beat)
        assert machine.step(EXPIRES_S - 1) == 1

    assert machine.step(EXPIRES_S) == 0
    invite(store, "two")
    assert machine.step(1.0) == 1
    assert machine.joined == ["one", "two"]


def test_a_batch_on_which_no_worker_lives_is_left_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    store = MemoryStore()
    machine = Machine(store, monkeypatch)
    for name in ("one", "two"):
        invite(store, name)
    machine.step()
    machine.workers[0].code = 1
    machine.step()
    machine.workers[1].code = 1

    machine.step()
    machine.step()

    assert machine.joined == ["one", "one", "two"]
    machine.helpers.close()
    invite(store, "two", 7)
    invite(store, "one", 7)
    machine.step()
    invite(store, "one", 0)
    machine.step()
    machine.helpers.close()
    machine.step()
    assert machine.joined == ["one", "one", "two", "two", "one"], "its scheduler was started again"


def test_an_invitation_is_renewed_until_it_is_withdrawn() -> None:
    store = MemoryStore()
    invitation = Invitation(store, ClusterKey("certificate", "pem"), name="one", renew_s=0.01)
    invitation.announce("tls://127.0.0.1:1")
    until = time.monotonic() + 20
    while next(iter(invitations(store).values())).beat < 3:
        assert time.monotonic() < until, "it was not renewed"

    invitation.withdraw()

    threading.Event().wait(0.05)
    assert not invitations(store)


@pytest.mark.slow
def test_a_part_is_computed_by_an_invited_helper(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    settings = PlatformSettings().replace(data={"store": f"dir:{tmp_path}"})
    graph, _ = make_sphere(1, rings=4, per_ring=6)
    name = put_input(store, PartResult(arrays=graph_arrays(graph)))
    part = Part(kind="optimise", inputs=(name,), arguments={"options": {}})
    key = new_cluster_key()
    cluster, invitation = LocalCluster(key, 0), Invitation(store, key)
    engine = DaskEngine(store, settings, cluster, key, on_start=invitation.announce)
    helpers = BatchHelpers(store, 1)
    try:
        engine.start()
        helpers.step(may_help=True)
        (pid,) = helpers.pids
        engine.run([part], lambda _: None)
        helpers.step(may_help=True)
        assert helpers.pids == [pid]
        invitation.withdraw()
        helpers.step(may_help=True)
        assert helpers.pids == []
    finally:
        helpers.close()
        engine.close()
        cluster.stop()

    assert read_result(store, part.name).arrays["poses"].shape == (24, 4, 4)
