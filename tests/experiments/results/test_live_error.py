"""The figures of a live map, from records whose errors are known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory, write_trajectory
from rse_pf.extensions.experiments.results.live_error import (
    LIVE_RECORDS,
    live_figures,
    live_lines,
    read_live_drives,
)
from rse_pf.extensions.experiments.results.records import TRUTH
from rse_pf.geometry import Array, Camera, exp_se3, inverse
from rse_pf.maps.format import Keyframe, MapVersion

FRAMES = 20
CAMERA = Camera(fx=500.0, fy=500.0, cx=159.5, cy=119.5, width=320, height=240)
T_MAP_TRUTH = exp_se3([1.0, -2.0, 0.5, 0.1, 0.3, -0.2])


def true_poses(number: int) -> list[Array]:
    return [exp_se3([0.1 * row, number + 0.01 * row**2, 0.0, 0.0, 0.02 * row, 0.0]) for row in range(FRAMES)]


def write_drive(folder: Path, name: str, number: int, *, joins_at: int | None, off_m: float) -> None:
    """Write a robot that drives without drift; its poses are given out *off_m* wrong."""
    (folder / name).mkdir()
    truth = true_poses(number)
    lines: list[dict[str, Any]] = []
    for row, pose in enumerate(truth):
        T_odom = inverse(truth[0]) @ pose
        T_map = T_MAP_TRUTH @ pose
        T_map[1, 3] += off_m * (-1) ** row
        is_aligned = joins_at is not None and row >= joins_at
        lines.append(
            {
                "event": "frame",
                "t": row / 10,
                "stamp": row / 10,
                "segment": 0,
                "T_odom": T_odom.ravel().tolist(),
                "T_map": T_map.ravel().tolist() if is_aligned else None,
                "by": "map" if is_aligned else "nothing",
                "owner": "server-1" if row < 10 else "server-2",
            }
        )
    lines.append({"event": "keyframe", "number": 3, "sent": 0.5, "kept": 0.53})
    lines.append({"event": "correction", "t": 0.62, "segment": 0, "cause": ["robot-1", 3]})
    lines.append({"event": "correction", "t": 0.7, "segment": 0, "cause": None})
    lines.append({"event": "end", "relocalisations": {"ok": 1}, "keyframes_waiting": 0})
    (folder / name / LIVE_RECORDS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    stamps = np.arange(FRAMES) / 10
    write_trajectory(folder / name / TRUTH, Trajectory(stamps, np.array(truth)))


def published() -> MapVersion:
    """Return a map with each fifth frame of both robots as a keyframe, exactly where it is."""
    keyframes = [
        Keyframe(
            id=100 * number + row, robot=f"robot-{number + 1}", timestamp_s=row / 10, camera=CAMERA,
            T_world_camera=T_MAP_TRUTH @ pose, pixels=np.zeros((1, 2), np.float32),
            descriptors=np.zeros((1, 32), np.uint8), points_camera=np.ones((1, 3), np.float32),
        )
        for number in range(2)
        for row, pose in enumerate(true_poses(number))
        if row % 5 == 0
    ]  # fmt: skip
    return MapVersion(keyframes=tuple(keyframes))


def test_figures_say_errors_joins_and_delays(tmp_path: Path) -> None:
    write_drive(tmp_path, "robot-1", 0, joins_at=0, off_m=0.02)
    write_drive(tmp_path, "robot-2", 1, joins_at=5, off_m=0.02)
    drives = read_live_drives(tmp_path, ["robot-1", "robot-2"])

    live = live_figures(drives, published())

    assert live["final_ate_cm"] == pytest.approx(0.0, abs=0.01)
    assert live["online_ate_cm"] == pytest.approx(2.0, abs=0.1)
    assert (live["joined"], live["join_frame"]) == (2, [0, 5])
    assert (live["aligned_percent"], live["aligned_percent_by_robot"]) == (87.5, [100.0, 75.0])
    assert live["correction_ms"] == {"p50": 120.0, "p99": 120.0, "n": 2}
    assert live["owners"] == ["server-1", "server-2"]
    assert live["relocalisations"] == {"ok": 2}
    assert "2 of 2 in one live map" in live_lines(live, 2)


@pytest.mark.parametrize(
    ("scales", "says"), [(("up to scale", "up to scale"), True), (("up to scale", "metric, by depth"), False)]
)
def test_a_map_of_robots_with_one_lens_says_why_none_joined(
    tmp_path: Path, scales: tuple[str, str], says: bool
) -> None:
    for number, scale in enumerate(scales):
        name = f"robot-{number + 1}"
        write_drive(tmp_path, name, number, joins_at=None, off_m=0.0)
        path = tmp_path / name / LIVE_RECORDS
        path.write_text(path.read_text().replace('"event": "end"', f'"event": "end", "scale": "{scale}"'))

    lines = live_lines(live_figures(read_live_drives(tmp_path, ["robot-1", "robot-2"]), None), 2)

    assert ("no robot has metres" in lines) == says
    assert ("hint: let one of them have depth" in lines) == says
