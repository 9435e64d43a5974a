"""The figures of a live map that met a fault, from a log and records whose losses are known."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory, write_trajectory
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.results.live_error import LIVE_RECORDS
from rse_pf.extensions.experiments.results.live_faults import fault_rows, live_fault_figures
from rse_pf.extensions.experiments.results.log_replay import read_log
from rse_pf.extensions.experiments.results.records import TRUTH, Records
from rse_pf.geometry import Camera, exp_se3
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.live_map.events import KeyframeAdded, MapServerChanged, encode_events
from rse_pf.server.live_map.lease import map_folder
from rse_pf.server.live_map.map_server.log import LiveLog
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe, make_features
from rse_pf.storage.object_store import DirectoryStore

NUMBERS = range(4)
FAULT_S, RELEASED_S, SERVING_S = 12.0, 12.5, 14.25


def keyframe(number: int, *, stamp: float | None = None) -> KeyframeAdded:
    rng = np.random.default_rng(number)
    pixels, descriptors = rng.uniform(10, 200, (40, 2)), rng.integers(0, 256, (40, 32), dtype=np.uint8)
    made = SentKeyframe(
        timestamp_s=number / 5 if stamp is None else stamp,
        T_odom_camera=exp_se3([0.1 * number, 0, 0, 0, 0, 0]),
        camera=Camera(fx=500.0, fy=500.0, cx=159.5, cy=119.5, width=320, height=240),
        features=make_features(pixels, rng.uniform(1, 3, 40), descriptors),
    )
    return KeyframeAdded(robot="robot-1", segment=0, number=number, data=encode_keyframe(made))


def write_run(folder: Path, keyframes: list[KeyframeAdded], *, fault: str = "kill", **more: Any) -> Records:
    """Write a robot that has the acknowledgement of four keyframes, and a log of *keyframes*."""
    store = DirectoryStore(folder / "platform" / "objects")
    where = map_folder(DEFAULT_TENANT, "demo")
    log = LiveLog(store, where, owner="one", epoch=1)
    log.write_entry(encode_events([MapServerChanged(owner="one", epoch=1)]))
    for each in keyframes[:2]:
        log.write_entry(encode_events([each]))
    second = LiveLog(store, where, owner="two", epoch=2)
    second.position = log.position
    position = second.write_entry(encode_events([MapServerChanged(owner="two", epoch=2)]))
    for each in keyframes[2:]:
        position = second.write_entry(encode_events([each]))
    (folder / "robot-1").mkdir()
    lines: list[dict[str, Any]] = [
        {
            "event": "frame", "t": row / 5, "stamp": row / 5, "segment": 0, "T_map": None, "by": "nothing",
            "T_odom": np.eye(4).ravel().tolist(), "owner": "one",
        }
        for row in NUMBERS
    ]  # fmt: skip
    lines += [{"event": "keyframe", "number": row, "sent": row / 5, "kept": row / 5 + 0.1} for row in NUMBERS]
    lines.append({"event": "end", "relocalisations": {}, "keyframes_waiting": 0, "keyframes": len(NUMBERS)})
    (folder / "robot-1" / LIVE_RECORDS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    stamps = np.array(NUMBERS) / 5
    write_trajectory(folder / "robot-1" / TRUTH, Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1))))
    final = {"digest": read_log(folder / "platform" / "objects", position).digest, "position": position}
    events = [
        {"time": 0.0, "action": "experiment", "kind": "live-fault", "fault": fault, "robots": 1},
        {"time": 2.0, "action": "robots-start", "robots": 1, "after_s": 3.0},
        {"time": FAULT_S, "action": "fault", "fault": fault, "owner": "one", "server": "server-1"},
        {"time": SERVING_S, "action": "lease", "owner": "two", "state": "serving", "epoch": 2},
        {"time": 20.0, "action": "final-map", **final, **more},
    ]
    return Records(commands=[], events=events, samples=[], folder=folder)


def test_a_run_that_lost_nothing_meets_every_target(tmp_path: Path) -> None:
    records = write_run(tmp_path, [keyframe(number) for number in NUMBERS])

    run = live_fault_figures(records)

    kept = run["keyframes"]
    assert (kept["acknowledged"], kept["in_log"]) == (4, 4)
    assert (kept["lost"], kept["twice"], kept["out_of_order"], kept["ahead_of_poses"]) == (0, 0, 0, 0)
    assert (run["at_s"], run["new_owner_s"], run["owners"]) == (7.0, 2.25, 2)
    assert run["replay_equal"] == 1
    assert all(bar["held"] for bar in run["bars"].values())
    assert fault_rows({"kill": run})[1][-1] == "all met"


@pytest.mark.parametrize(
    ("logged", "what"),
    [
        ([0, 1, 3], "lost"),
        ([0, 1, 2, 2, 3], "twice"),
        ([0, 2, 1, 3], "out_of_order"),
    ],
)
def test_a_keyframe_that_is_lost_twice_or_out_of_order_shows(
    tmp_path: Path, logged: list[int], what: str
) -> None:
    run = live_fault_figures(write_run(tmp_path, [keyframe(number) for number in logged]))

    assert run["keyframes"][what] > 0
    assert not run["bars"][f"keyframes/{what}"]["held"]
    assert f"keyframes/{what}" in fault_rows({"kill": run})[1][-1]


def test_another_map_than_that_of_the_log_shows(tmp_path: Path) -> None:
    records = write_run(tmp_path, [keyframe(number) for number in NUMBERS], digest="of another map")

    assert not live_fault_figures(records)["bars"]["replay_equal"]["held"]


def test_a_log_is_replayed_with_one_thread_as_owners_compute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\nexit "$OPENBLAS_NUM_THREADS"\n', encoding="ascii")
    python.chmod(0o755)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    monkeypatch.setattr(sys, "executable", str(python))

    with pytest.raises(UsageError, match=r"cannot replay the log in .*: exit code 1\n"):
        read_log(tmp_path, 6)
