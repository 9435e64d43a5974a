"""The picture shows the map's own points, in their own colours."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.maps.map_image import _BACKGROUND, RobotPath, draw_map

image = pytest.importorskip("PIL.Image")


def draw(tmp_path, points, colours):
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.linspace(0.0, 1.0, 5)
    path = tmp_path / "map.png"
    draw_map(path, points, colours, [RobotPath(name="robot-1", T_world_camera=poses)], "a caption")
    with image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def count(picture, colour):
    return int((picture == np.array(colour)).all(axis=2).sum())


def test_an_empty_map_is_an_empty_image(tmp_path):
    picture = draw(tmp_path, np.empty((0, 3), dtype=np.float32), np.empty((0, 3), dtype=np.uint8))
    assert count(picture[64:836], _BACKGROUND) > 0.9 * 1600 * 772
