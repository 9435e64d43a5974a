"""Trajectories of cameras, and their files in TUM format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory, read_trajectory, write_trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import exp_se3


def test_a_trajectory_comes_back_from_its_file(tmp_path: Path):
    poses = np.array([exp_se3([0.1 * i, -0.2, 0.3, 0.4 * i, 0.1, -0.2]) for i in range(8)])
    trajectory = Trajectory(1305031102.1753 + np.arange(8) / 30, poses)

    write_trajectory(tmp_path / "t.txt", trajectory)
    again = read_trajectory(tmp_path / "t.txt")

    np.testing.assert_allclose(again.timestamps_s, trajectory.timestamps_s, atol=1e-6)
    np.testing.assert_allclose(again.T_world_camera, poses, atol=1e-8)
    first = (tmp_path / "t.txt").read_text().splitlines()[1].split()
    assert [float(word) for word in first[4:]] == pytest.approx([0, 0.05, -0.0998, 0.9938], abs=2e-3)


@pytest.mark.parametrize("line", ["1 2 3", "0 0 0 0 0 0 0 0", "0 0 0 nan 0 0 0 1", "a b c d e f g h"])
def test_a_line_that_is_no_pose_names_its_number(tmp_path: Path, line: str):
    (tmp_path / "t.txt").write_text(f"# stamps\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(UsageError, match="line 3"):
        read_trajectory(tmp_path / "t.txt")
