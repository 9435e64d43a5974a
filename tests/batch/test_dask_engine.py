"""Parts on real processes: a killed worker and a killed scheduler cost time, and strangers are refused."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import ssl
from pathlib import Path

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import Crashed
from rse_pf.extensions.batch.dask_engine import DaskEngine, LocalCluster
from rse_pf.extensions.batch.merge import BatchMerge
from rse_pf.extensions.batch.parts import Part
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.slam.map_merge import Atlas, MergeOptions, merge_versions, propose_loop_closures
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.synthetic_maps import make_world

pytestmark = pytest.mark.slow

for package in ("distributed", "gtsam"):
    pytest.importorskip(package, reason="the extra batch is not installed")


@pytest.fixture
def versions() -> list[MapVersion]:
    world = make_world(1)
    a, _ = world.walk("a", np.linspace(0.0, 0.5, 13), seed=1)
    b, _ = world.walk("b", np.linspace(0.3, 0.8, 13), seed=2)
    return [a, b]


def test_a_merge_survives_its_workers_and_its_scheduler(tmp_path: Path, versions: list[MapVersion]) -> None:
    store = DirectoryStore(tmp_path)
    for name, version in zip("ab", versions, strict=True):
        store.put(name, encode_map(version))
    settings = PlatformSettings().replace(data={"store": f"dir:{tmp_path}"}, batch={"pairs_per_part": 10})
    events, killed = [], []
    cluster = LocalCluster(2)
    engine = DaskEngine(store, settings, cluster, on_event=events.append)

    def report(done: float, what: str) -> None:
        if "parts of links" in what and not killed:
            killed.append(cluster.worker_pids[0])
            os.kill(cluster.worker_pids[0], signal.SIGKILL)
        elif what.startswith("4 of") and len(killed) == 1:
            killed.append(cluster.scheduler_pid)
            os.kill(cluster.scheduler_pid, signal.SIGKILL)

    try:
        engine.start()
        found = BatchMerge(store, engine, settings).run(["a", "b"], report)
    finally:
        engine.close()
        cluster.stop()

    assert len(killed) == 2
    assert "the connection to the scheduler was lost and is there again" in events
    expected = propose_loop_closures(Atlas.of(versions), MergeOptions()).loop_closures
    assert len(found.links) == len(expected)
    for one, other in zip(found.links, expected, strict=True):
        assert np.array_equal(one.T_a_b, other.T_a_b)
    whole = merge_versions(versions)
    for one, other in zip(found.merged.version.keyframes, whole.version.keyframes, strict=True):
        assert np.abs(one.T_world_camera - other.T_world_camera).max() < 1e-4


def test_a_part_that_ends_its_workers_ends_the_job_and_not_all_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compute(settings: bytes, part: bytes) -> None:
        os._exit(3)

    monkeypatch.setattr("rse_pf.extensions.batch.dask_engine.compute", compute)
    settings = PlatformSettings().replace(data={"store": f"dir:{tmp_path}"})
    events: list[str] = []
    cluster = LocalCluster(1, part_tries=2)
    engine = DaskEngine(DirectoryStore(tmp_path), settings, cluster, on_event=events.append)
    try:
        engine.start()
        with pytest.raises(Crashed, match="ended 2 workers"):
            engine.run([Part(kind="vectors", inputs=())], lambda _: None)
    finally:
        engine.close()
        cluster.stop()
    assert "1 worker replaced, which had ended" in events


def test_who_has_not_the_key_is_refused() -> None:
    cluster = LocalCluster(0)
    try:
        cluster.start()
        host, port = cluster.address.removeprefix("tls://").rsplit(":", 1)
        stranger = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        stranger.check_hostname, stranger.verify_mode = False, ssl.CERT_NONE
        answer = b""
        with (
            socket.create_connection((host, int(port)), timeout=10) as plain,
            contextlib.suppress(ssl.SSLError, ConnectionError),
            stranger.wrap_socket(plain) as wrapped,
        ):
            answer = wrapped.recv(1)  # TLS 1.3 refuses a client without a certificate here
        assert answer == b""
    finally:
        cluster.stop()


def sockets_of(pid: int) -> list[tuple[str, int]]:
    """Return address (hexadecimal, as the kernel shows it) and port of what the process *pid* listens at."""
    inodes = set()
    for name in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(OSError):
            inodes.add(os.readlink(f"/proc/{pid}/fd/{name}"))
    found = []
    for family in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{family}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
                address, port = fields[1].split(":")
                found.append((address, int(port, 16)))
    return found


def test_every_process_listens_at_one_port_on_the_given_host(tmp_path: Path) -> None:
    cluster = LocalCluster(2)
    engine = DaskEngine(DirectoryStore(tmp_path), PlatformSettings(), cluster)
    try:
        engine.start()
        engine._connect()
        engine._client.wait_for_workers(2, timeout=60)
        listening = [sockets_of(pid) for pid in (cluster.scheduler_pid, *cluster.worker_pids)]
    finally:
        engine.close()
        cluster.stop()

    assert [len(each) for each in listening] == [1, 1, 1]
    assert {address for each in listening for address, _ in each} == {"0100007F"}


def test_connections_that_shake_no_hands_are_cut_and_a_client_is_served_meanwhile(tmp_path: Path) -> None:
    cluster = LocalCluster(1)
    engine = DaskEngine(DirectoryStore(tmp_path), PlatformSettings(), cluster)
    with contextlib.ExitStack() as stack:
        stack.callback(cluster.stop)
        stack.callback(engine.close)
        cluster.start()
        host, _, port = cluster.address.removeprefix("tls://").rpartition(":")
        silent = [
            stack.enter_context(socket.create_connection((host, int(port)), timeout=20)) for _ in range(300)
        ]
        engine._connect()
        for each in silent:
            with contextlib.suppress(ConnectionError):
                assert each.recv(1) == b""
        engine._client.wait_for_workers(1, timeout=60)
