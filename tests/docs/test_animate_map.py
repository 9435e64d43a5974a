"""The animation of the README: it grows, it repeats itself byte for byte, and it is of real files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.mapping import write_ply

pytest.importorskip("PIL", reason="Pillow is not installed")

from scripts.animate_map import PAPER, animate, frames, main, read_drives


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    """The files of a demo with two robots and a few points."""
    for number in (1, 2):
        folder = tmp_path / "out" / f"robot-{number}"
        folder.mkdir(parents=True)
        rng = np.random.default_rng(number)
        points = rng.uniform([number, 0.0, 0.0], [number + 3.0, 2.0, 3.0], (3000, 3))
        points = points[np.argsort(points[:, 0])]
        write_ply(folder / "map.ply", points, np.full((3000, 3), 90, np.uint8))
        rows = [f"{step}.0 {number + step / 4} 1 1 0 0 0 1" for step in range(12)]
        (folder / "trajectory.txt").write_text("# comment\n" + "\n".join(rows) + "\n")
    return tmp_path / "out"


def test_each_picture_shows_more_of_the_map(demo: Path) -> None:
    drawn = [(np.asarray(picture) != PAPER).any(axis=2).sum() for picture in frames(read_drives(demo), 4)]

    assert len(drawn) == 4
    assert drawn == sorted(drawn)
    assert drawn[3] > 1.5 * drawn[0]


def test_equal_files_give_equal_animations(demo: Path, tmp_path: Path) -> None:
    for name in ("a.gif", "b.gif"):
        assert animate(list(frames(read_drives(demo), 3)), tmp_path / name) > 0

    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_the_ceiling_is_left_out(demo: Path) -> None:
    assert all(drive.points[:, 2].max() < 2.2 for drive in read_drives(demo))


def test_a_folder_without_a_demo_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="run make demo first"):
        main([str(tmp_path), str(tmp_path / "x.gif")])
