"""The demo with a live map: robots correct each other while they drive, also when a server is killed."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import main
from rse_pf.errors import NotFound
from rse_pf.extensions.experiments.results.live_error import live_figures, read_live_drives, read_live_map
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.server.live_map.lease import decode_lease, lease_name
from rse_pf.storage.object_store import DirectoryStore
from tests.system.demo.test_demo import demo, finish, pids_of, read_until

pytest.importorskip("gtsam", reason="the extra maps is not installed")
pytestmark = [pytest.mark.system, pytest.mark.slow]

RECORDING = Path(__file__).parents[3].parent / "shared" / "data" / "7scenes_redkitchen"


def owner_of(objects: Path, entries: int, within_s: float) -> str:
    """Return the name of the server that owns the map of the demo, once its log has so many *entries*."""
    end, pause = time.monotonic() + within_s, threading.Event()
    name = lease_name(DEFAULT_TENANT, "demo")
    log = objects / "live" / DEFAULT_TENANT / "demo" / "log"
    while time.monotonic() < end:
        try:
            record = decode_lease(name, DirectoryStore(objects).get(name))
            if record.state == "serving" and len(list(log.glob("0*"))) >= entries:
                return record.server
        except NotFound:
            pass
        pause.wait(0.05)
    raise AssertionError("no server owns the map")


def numbers_in_order(out: Path, robots: int) -> list[list[int]]:
    """Return the numbers of the keyframes that the map acknowledged, for each robot."""
    drives = read_live_drives(out, [f"robot-{row + 1}" for row in range(robots)])
    return [[each["number"] for each in drive.keyframes] for drive in drives]


@pytest.mark.data
@pytest.mark.timeout(300)
def test_three_robots_in_the_red_kitchen_share_one_live_map(tmp_path: Path) -> None:
    if not RECORDING.is_dir():
        pytest.skip(f"there is no recording {RECORDING}")
    out = tmp_path / "out"

    options = ("--data", str(RECORDING), "--rate", "10", "--robots", "3", "--live")
    with demo(out, *options, within_s=280) as process:
        report = finish(process, out, within_s=280)

    live: dict[str, Any] = report["live"]
    assert (report["lost_frames"], live["joined"], live["keyframes_waiting"]) == (0, 3, 0)
    assert live["final_ate_cm"] <= 3.7
    assert live["online_ate_cm"] <= 4.2
    assert live["correction_ms"]["n"] >= 10
    for numbers in numbers_in_order(out, 3):
        assert numbers == list(range(len(numbers)))
    drives = read_live_drives(out, ["robot-1", "robot-2", "robot-3"])
    assert json.loads(json.dumps(live_figures(drives, read_live_map(out)))) == live
    assert not list((out / "platform").rglob("key=*"))


@pytest.mark.timeout(300)
def test_no_keyframe_is_lost_when_the_server_of_the_owner_is_killed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--robots", "2", "--frames", "60", "--rate", "5", "--live")

    with demo(out, *options, within_s=280) as process:
        running = read_until(process, r"running at .*")
        servers = dict(zip(re.findall(r"server-\d", running), pids_of(running), strict=True))
        read_until(process, "the robots start")
        first = owner_of(out / "platform" / "objects", entries=8, within_s=60.0)
        os.kill(servers[first], signal.SIGKILL)
        report = finish(process, out, within_s=280)

    live = report["live"]
    assert (report["lost_frames"], live["keyframes_waiting"]) == (0, 0)
    assert report["commands"]["lost"] == report["commands"]["twice"] == 0
    assert len(live["owners"]) >= 2
    for numbers in numbers_in_order(out, 2):
        assert numbers == list(range(len(numbers)))
    assert live["keyframes"] >= 16
    assert main(["map", "export", report["map"], "--store", report["store"], "--format", "g2o",
                 "--out", str(tmp_path / "demo.g2o")]) == 0  # fmt: skip
