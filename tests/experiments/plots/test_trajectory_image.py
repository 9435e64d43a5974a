"""The picture of trajectories: truth and paths in their colours, with gaps where frames were lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory
from rse_pf.extensions.experiments.plots.map_image import COLOURS
from rse_pf.extensions.experiments.plots.trajectory_image import (
    _TRUTH,
    DrawnPath,
    Panel,
    draw_trajectories,
)

image = pytest.importorskip("PIL.Image")


def circle(frames: int = 60, radius_m: float = 1.0) -> Trajectory:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    angles = np.linspace(0.0, 5.0, frames)
    poses[:, 0, 3], poses[:, 2, 3] = radius_m * np.cos(angles), radius_m * np.sin(angles)
    return Trajectory(np.arange(frames) / 10, poses)


def count(path: Path, colour: tuple[int, int, int]) -> int:
    with image.open(path) as picture:
        return int((np.asarray(picture.convert("RGB")) == np.array(colour)).all(axis=2).sum())


def test_truth_and_paths_are_drawn_in_a_panel_for_each_recording(tmp_path: Path) -> None:
    drawn = tuple(DrawnPath(name=f"c{n}", path=circle(radius_m=1.0 + 0.2 * n)) for n in range(2))
    panel = Panel(title="a recording", truth=circle(radius_m=0.8), paths=drawn)

    draw_trajectories(tmp_path / "x.png", [panel, panel, panel])

    with image.open(tmp_path / "x.png") as picture:
        assert picture.size == (1600, 1280)
    for colour in (_TRUTH, *COLOURS[:2]):
        assert count(tmp_path / "x.png", colour) > 1000


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_a_recording_with_hardly_a_pose_is_drawn(tmp_path: Path, frames: int) -> None:
    panel = Panel(title="x", truth=None, paths=(DrawnPath(name="a", path=circle(frames)),), unit="units")

    draw_trajectories(tmp_path / "x.png", [panel])

    assert (tmp_path / "x.png").stat().st_size > 0
