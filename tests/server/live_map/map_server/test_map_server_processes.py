"""Real map-server processes, killed, paused and released: no keyframe is lost or added twice."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import Conflict, NotFound, RsePfError
from rse_pf.identity import RobotId
from rse_pf.live_map.events import KeyframeAdded, decode_events, encode_events
from rse_pf.live_map.live_map import LiveMap
from rse_pf.server.live_map.client import LiveMapClient
from rse_pf.server.live_map.lease import MapLease, decode_lease, lease_name, map_folder
from rse_pf.server.live_map.map_server.log import LiveLog
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.server.live_map.process_pool import (
    DEFAULT_IMPLEMENTATION,
    ClaimOrder,
    MapServerProcess,
    start_map_server,
)
from rse_pf.server.log import JsonLog
from rse_pf.storage.object_store import DirectoryStore
from rse_pf.wire.live_map import LiveMapRequest, LiveRequest
from tests.kit.fake_map import FAKE_MAP, keyframe_request
from tests.kit.generated_drives import GeneratedWorld, circle

MAP, ROBOT = "warehouse", RobotId("default", "robot-1")
KIND = "tests.kit.fake_map:FAKE_MAP"
PATIENT_S = 30.0
pytestmark = [pytest.mark.slow, pytest.mark.system]


@dataclass
class Servers:
    """The clients of two backend servers, in one process and on one store."""

    store: DirectoryStore
    a: LiveMapClient
    b: LiveMapClient
    updates: list[dict[str, Any]]

    async def send(self, client: LiveMapClient, number: int) -> dict[str, Any]:
        return await client.request(
            "default", MAP, ROBOT, "live-keyframe", keyframe_request(number), PATIENT_S
        )

    async def show(self, client: LiveMapClient) -> dict[str, Any]:
        return await client.request("default", MAP, ROBOT, "live-show", LiveMapRequest(map=MAP), PATIENT_S)

    async def serving_process(self) -> MapServerProcess:
        """Return the process that serves the map; on a busy machine another one may be about to."""
        name, end_s = lease_name("default", MAP), time.monotonic() + PATIENT_S
        while time.monotonic() < end_s:
            epoch = decode_lease(name, self.store.get(name)).epoch
            for child in (*self.a.processes, *self.b.processes):
                if child.epoch == epoch:
                    return child
            await asyncio.wait({asyncio.ensure_future(self.show(self.b))})
        raise AssertionError("no process serves the map")

    def replayed(self) -> tuple[MapState, list[int]]:
        """Return the map that the whole log gives, and the numbers of the keyframes in it."""
        log = LiveLog(self.store, map_folder("default", MAP), owner="", epoch=10**6)
        state, numbers = MapState(FAKE_MAP.empty(), 0), []
        for entry in log.read_entries():
            events = decode_events(entry.events)
            numbers += [event.number for event in events if isinstance(event, KeyframeAdded)]
            state.apply(log.position, events)
        return state, numbers


@asynccontextmanager
async def servers(folder: Path, *, implementation: str = KIND, **live: Any) -> AsyncIterator[Servers]:
    settings = PlatformSettings.from_dict(
        {
            "data": {"store": f"dir:{folder}"},
            "live": {"keep_log": True, **live},
            "serving": {"log_level": "error"},
        }
    )
    store, updates = DirectoryStore(folder), []  # type: tuple[DirectoryStore, list[dict[str, Any]]]
    log = JsonLog(level="error", server="test", wall_clock=time.time).start()
    clients = [
        LiveMapClient(
            store=store,
            settings=settings,
            server_id=name,
            log=log,
            on_update=lambda tenant, name, payload: updates.append(payload),
            implementation=implementation,
        )
        for name in ("a", "b")
    ]
    try:
        yield Servers(store, clients[0], clients[1], updates)
    finally:
        for client in clients:
            await client.close()
        log.close()


@pytest.mark.parametrize("fault", [signal.SIGKILL, signal.SIGSTOP])
async def test_a_server_that_dies_or_stands_still_loses_no_acknowledged_keyframe(
    tmp_path: Path, fault: signal.Signals
) -> None:
    async with servers(tmp_path) as both:
        await both.send(both.a, 0)
        number, took = 1, []
        for _ in range(2):
            for _ in range(12):
                await both.send(both.b, number)
                number += 1
            process = await both.serving_process()
            sent = asyncio.ensure_future(both.send(both.b, number))
            await asyncio.sleep(0)
            began = time.monotonic()
            os.kill(process.pid, fault)
            assert (await sent)["number"] == number + 1
            number += 1
            await both.send(both.b, number)
            number += 1
            took.append(time.monotonic() - began)
            if fault == signal.SIGSTOP:
                os.kill(process.pid, signal.SIGCONT)
                assert await asyncio.wait_for(asyncio.shield(process.exited), PATIENT_S) == 0
        shown = await both.show(both.b)
        assert shown["epoch"] >= 3  # more where the machine is so busy that a lease ends
        state, numbers = both.replayed()
        assert numbers == list(range(number))
        assert state.keyframes == shown["keyframes"] == number
        assert max(took) < 10.0  # 3 s on a machine that does nothing else; see docs/live_maps.md


@pytest.mark.parametrize("attackers_drive", [False, True])
async def test_a_tenant_with_most_map_servers_gives_one_up_within_seconds(
    tmp_path: Path, attackers_drive: bool
) -> None:
    hostile, victim = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")

    async with servers(tmp_path, max_owners=4, idle_s=6.0) as both:

        async def drive(robot: RobotId, name: str, number: int) -> dict[str, Any]:
            return await both.a.request(
                robot.tenant, name, robot, "live-keyframe", keyframe_request(number), PATIENT_S
            )

        async def drive_on(name: str) -> None:
            number = 1
            while True:
                with contextlib.suppress(RsePfError):
                    await both.a.request(
                        "acme", name, hostile, "live-keyframe", keyframe_request(number), 1.0
                    )
                    number += 1

        for name in ("m1", "m2", "m3"):
            both.a.watch("acme", name)
            await drive(hostile, name, 0)
        driving = [
            asyncio.ensure_future(drive_on(name)) for name in ("m1", "m2", "m3")[: 3 * attackers_drive]
        ]
        await drive(victim, "v1", 0)
        number, end_s = 1, time.monotonic() + PATIENT_S
        while not attackers_drive and any(  # they are only watched in the end
            child.unused_since_s is None for child in both.a.processes if child.tenant == "acme"
        ):
            assert time.monotonic() < end_s
            await drive(victim, "v1", number)
            number += 1
        began_s = time.monotonic()
        assert (await drive(victim, "v2", 0))["number"] == 1
        assert time.monotonic() - began_s < 10.0
        assert (await drive(victim, "v1", number))["number"] == number + 1
        assert sorted(child.tenant for child in both.a.processes).count("rival") == 2
        for task in driving:
            task.cancel()


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """Yield a folder on a disk of its own."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("this test mounts a small disk, which takes the rights of root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def test_one_tenant_fills_the_disk_and_is_refused_while_keyframes_of_the_other_are_kept(
    tmp_path: Path,
) -> None:
    hostile, victim = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")

    async def test(disk: Path) -> None:
        async with servers(disk, publish_pause_s=0.5) as both:

            async def ask(robot: RobotId, operation: str, request: LiveRequest) -> dict[str, Any]:
                client = both.a if robot is hostile else both.b
                return await client.request(robot.tenant, MAP, robot, operation, request, PATIENT_S)

            acknowledged, number, refused = 0, 0, Counter[str]()
            for turn in range(1500):
                try:
                    await ask(hostile, "live-keyframe", keyframe_request(number, os.urandom(30_000)))
                    number += 1
                except RsePfError as error:
                    refused[error.code] += 1
                    if refused.total() > 50:
                        break
                await ask(hostile, "live-leave", LiveMapRequest(map=MAP))
                if not turn % 10 or refused:
                    answer = await ask(
                        victim, "live-keyframe", keyframe_request(acknowledged, os.urandom(30_000))
                    )
                    acknowledged += 1
                    assert answer["number"] == acknowledged
            assert set(refused) == {"store-full"}
            assert acknowledged >= 50
            assert shutil.disk_usage(disk).free > 0

    with small_disk(tmp_path / "disk", "24m") as disk:
        asyncio.run(test(disk))


def listens(pid: int) -> bool:
    """Return whether a process listens at a TCP port."""
    own = {os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir()}
    rows = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    return any(row[3] == "0A" and f"socket:[{row[9]}]" in own for row in rows)


async def test_a_process_listens_only_once_it_has_a_map(tmp_path: Path) -> None:
    """Unauthenticated clients could fill the backlog of a process that does not accept connections."""

    settings = PlatformSettings.from_dict({"data": {"store": f"dir:{tmp_path}"}})
    child = MapServerProcess(start_map_server(settings, KIND)).start_reading()
    try:
        await child.wait_ready(PATIENT_S)
        assert child.is_ready
        assert not listens(child.pid)
        order = ClaimOrder(tenant="default", map_name=MAP, server="a", known=None)
        assert await asyncio.wait_for(child.claim(order), PATIENT_S)
        assert listens(child.pid)
    finally:
        child.kill()


async def test_a_drained_server_gives_its_maps_to_the_next_one_at_once(tmp_path: Path) -> None:
    async with servers(tmp_path) as both:
        both.b.watch("default", MAP)
        for number in range(5):
            await both.send(both.a, number)
        before = await both.show(both.a)
        both.a.give_up()
        assert (await both.send(both.b, 5))["number"] == 6
        after = await both.show(both.b)
        assert (before["server"], after["server"]) == ("a", "b")
        assert after["epoch"] == 2
        assert after["keyframes"] == 6
        assert [update["state"] for update in both.updates if update["kind"] == "map"][-1] == "live"


async def test_two_servers_that_begin_a_map_at_the_same_time_share_one_map_server(tmp_path: Path) -> None:
    async with servers(tmp_path) as both:
        other = RobotId("default", "robot-2")
        await asyncio.gather(
            both.send(both.a, 0),
            both.b.request("default", MAP, other, "live-keyframe", keyframe_request(0), PATIENT_S),
        )
        one, two = await both.show(both.a), await both.show(both.b)
        assert one["owner"] == two["owner"]
        assert one["keyframes"] == 2
        with pytest.raises(Conflict):
            await both.send(both.b, 9)


async def test_a_stopped_map_refuses_later_keyframes_and_another_tenant_sees_nothing(tmp_path: Path) -> None:
    async with servers(tmp_path) as both:
        await both.send(both.a, 0)
        stranger = RobotId("other", "robot-1")
        with pytest.raises(NotFound):
            await both.b.request("other", MAP, stranger, "live-publish", LiveMapRequest(map=MAP), PATIENT_S)
        assert await both.b.list_maps("other") == []
        stopped = await both.b.request("default", MAP, ROBOT, "live-stop", LiveMapRequest(map=MAP), PATIENT_S)
        assert stopped["keyframes"] == 1
        with pytest.raises(Conflict, match="was stopped"):
            await both.send(both.b, 1)
        assert (await both.send(both.b, 0))["number"] == 1


async def test_a_map_server_and_a_replay_make_the_same_map_with_any_number_of_blas_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests compute with one thread of BLAS; with two, the last bits of the poses would differ."""
    # 1. Store the log of two robots in one room, whose map server has released the map.
    world, live_map = GeneratedWorld(seed=1), LiveMap()
    drives = [world.drive("a", circle(0.5, 1.2)), world.drive("b", circle(0.5, 1.2, phase=3.0))]
    store = DirectoryStore(tmp_path)
    lease = MapLease(store, lease_name("default", MAP), owner="a-1", server="a", clock=time.monotonic)
    assert lease.claim(None)
    log = LiveLog(store, map_folder("default", MAP), owner="a-1", epoch=1)
    for event in world.play(drives):
        live_map.apply(event)
        log.write_entry(encode_events([event]))
    assert lease.release()
    # 2. Replay the log by the command line and in a map server, with two threads in the environment.
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    words = ["map", "live", "show", MAP, "--json", "--store", f"dir:{tmp_path}"]
    shown = subprocess.run(
        [sys.executable, "-c", f"from rse_pf.cli.main import main; main({words})"],
        capture_output=True,
        check=True,
        timeout=PATIENT_S,
    )
    async with servers(tmp_path, implementation=DEFAULT_IMPLEMENTATION) as both:
        served = await both.show(both.a)

    assert json.loads(shown.stdout)["digest"] == live_map.digest()
    for entry in log.read_entries():  # what the map server has logged before its reply
        if log.position <= served["version"]:
            for event in decode_events(entry.events):
                live_map.apply(event)
    assert served["digest"] == live_map.digest()
