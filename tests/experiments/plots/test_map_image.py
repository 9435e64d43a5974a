"""The picture shows the map's own points, in their own colours."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.extensions.experiments.plots.map_image import _BACKGROUND, RobotPath, _Observer, draw_map

image = pytest.importorskip("PIL.Image")


def draw(tmp_path, points, colours):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.linspace(0.0, 1.0, 5)
    path = tmp_path / "map.png"
    draw_map(path, points, colours, [RobotPath(name="robot-1", T_world_camera=poses)], "a caption")
    with image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def plane(y: float, n: int = 4000):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-2, 2, n), np.full(n, y), rng.uniform(0, 4, n)])
    return points.astype(np.float32)


def count(picture, colour):
    return int((picture == np.array(colour)).all(axis=2).sum())


def test_points_of_a_ceiling_are_not_drawn(tmp_path):
    floor, ceiling = plane(y=1.0), plane(y=-1.5)
    colours = np.array([[10, 200, 30]] * len(floor) + [[200, 10, 30]] * len(ceiling), dtype=np.uint8)
    picture = draw(tmp_path, np.vstack([floor, ceiling]), colours)
    assert count(picture, (10, 200, 30)) > 10_000
    assert count(picture, (200, 10, 30)) == 0


def test_a_path_that_begins_far_from_all_points_is_shown_whole(tmp_path):
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = np.linspace(12.0, 0.0, 50)
    points = plane(y=1.0, n=40_000)
    robot = RobotPath(name="robot-1", T_world_camera=poses)
    view = _Observer(points.astype(float), [robot], np.array([0.0, -1.0, 0.0]))

    x, y = view.project(poses[:, :3, 3]).T

    assert (x.min() > 0, x.max() < 1600) == (True, True)
    assert (y.min() > 0, y.max() < 900) == (True, True)


def test_an_empty_map_is_an_empty_image(tmp_path):
    picture = draw(tmp_path, np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8))
    assert count(picture[64:836], _BACKGROUND) > 0.9 * 1600 * 772
