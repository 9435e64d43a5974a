"""Point maps: means, depth edges, bounded cost and memory, and PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.frontend import Frame
from client_sdk.point_map import MapOptions, PointMap, read_ply, write_ply
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, exp_se3, transform
from tests.oracles import depths

CAMERA = Camera(fx=20.0, fy=20.0, cx=9.5, cy=7.5, width=20, height=16)


def random_points(seed: int, count: int, spread_m: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-spread_m, spread_m, (count, 3)), rng.integers(0, 256, (count, 3)).astype(np.uint8)


def test_a_map_in_many_pieces_equals_the_map_in_one():
    points, colours = random_points(1, 30_000)
    whole, pieces = PointMap(MapOptions(voxel_m=0.1)), PointMap(MapOptions(voxel_m=0.1))

    whole.add_points(points, colours)
    for rows in np.array_split(np.arange(len(points)), 13):
        pieces.add_points(points[rows], colours[rows])

    assert len(whole) == len(pieces) == len(np.unique(np.floor(points / 0.1), axis=0))
    a, b = (cloud.points()[0] for cloud in (whole, pieces))
    np.testing.assert_allclose(a[np.lexsort(a.T)], b[np.lexsort(b.T)], atol=1e-4)


@pytest.mark.parametrize("every_px", [1, 2, 3])
def test_a_map_of_frames_is_that_of_the_definition(every_px: int):
    rng = np.random.default_rng(2)
    options, pose = MapOptions(voxel_m=0.2, every_px=every_px), exp_se3(rng.normal(size=6) * 0.3)
    cloud, points, colours = PointMap(options), [], []
    for _ in range(3):
        depth_m = rng.choice(
            [0.0, 0.2, 2.0, 2.05, 2.3, 3.4, 3.6, np.nan], (16, 20), p=[0.05] * 4 + [0.65] + [0.05] * 3
        )
        frame = Frame(
            timestamp_s=0.0, rgb=rng.integers(0, 256, (16, 20, 3)).astype(np.uint8),
            depth_m=depth_m.astype(np.float32), camera=CAMERA,
        )  # fmt: skip
        seen, seen_colours = depths.frame_readings(frame, options)
        points.append(transform(pose, seen))
        colours.append(seen_colours)

        assert cloud.add(frame, pose) == len(seen) > 2

    expected = depths.voxel_means(np.concatenate(points), np.concatenate(colours), options.voxel_m)
    found, found_colours = cloud.points()
    assert len(found) == len(expected)
    for point, colour in zip(found, found_colours, strict=True):
        nearest = min(expected.values(), key=lambda mean: np.abs(mean[:3] - point).max())
        np.testing.assert_allclose(point, nearest[:3], atol=1e-5)
        np.testing.assert_allclose(colour, nearest[3:], atol=0.51)


@pytest.mark.parametrize("bad", [{"voxel_m": 0.0}, {"every_px": 0}, {"max_points": 0}])
def test_a_useless_map_option_is_refused(bad: dict[str, float]):
    with pytest.raises(UsageError):
        MapOptions(**bad)


def test_a_cut_or_missing_ply_file_is_reported_in_one_line(tmp_path: Path):
    write_ply(tmp_path / "map.ply", *random_points(5, 10))
    (tmp_path / "map.ply").write_bytes((tmp_path / "map.ply").read_bytes()[:-1])
    for name in ("map.ply", "none.ply"):
        with pytest.raises(UsageError) as caught:
            read_ply(tmp_path / name)
        assert "\n" not in caught.value.message
        assert caught.value.hint
