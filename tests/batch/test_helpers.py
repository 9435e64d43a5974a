"""Idle job servers compute parts of a batch that invites them, and leave when a job waits."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.batch.cluster import ClusterKey, DaskEngine, LocalCluster, new_cluster_key
from rse_pf.batch.helpers import BatchHelpers
from rse_pf.batch.invitation import Invitation
from rse_pf.batch.parts import Part, PartResult, put_input, read_result
from rse_pf.batch.tasks import graph_arrays
from rse_pf.config import PlatformSettings
from rse_pf.object_store import DirectoryStore, MemoryStore
from rse_pf.services.synthetic_maps import make_sphere

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
