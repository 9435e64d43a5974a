"""A COLMAP model holds the poses, pixels and tracks of a map; pycolmap reads it, where it is installed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rse_pf.extensions.map_export.colmap import encode_colmap
from rse_pf.extensions.map_export.tracks import find_tracks
from rse_pf.geometry import from_quaternion, inverse
from rse_pf.maps.format import Edge, MapVersion
from tests.kit.exact_maps import OTHER_CAMERA, points_map, world_map

NO_PYCOLMAP = "pycolmap is not installed, and in no lock: its wheel has 38 MB (pip install pycolmap==4.2.1)"


def rows_of(files: Mapping[str, bytes], name: str) -> list[list[str]]:
    return [line.split(" ") for line in files[name].decode("ascii").splitlines() if not line.startswith("#")]


def test_poses_lead_from_the_world_to_the_camera_with_w_first() -> None:
    version, _ = points_map()

    images = rows_of(encode_colmap(version), "images.txt")[::2]

    for keyframe, row in zip(version.keyframes, images, strict=True):
        w, x, y, z, *t = map(float, row[1:8])
        T_camera_world = inverse(keyframe.T_world_camera)
        np.testing.assert_allclose(from_quaternion([x, y, z, w]), T_camera_world[:3, :3], atol=1e-9)
        np.testing.assert_allclose(t, T_camera_world[:3, 3], atol=1e-9)
    assert [row[9] for row in images] == [f"robot-1-{10 * number:06d}.jpg" for number in range(5)]


def test_cameras_and_pixels_count_from_the_corner_of_the_image() -> None:
    version, _ = points_map(cameras=(points_map()[0].keyframes[0].camera, OTHER_CAMERA))

    files = encode_colmap(version)

    assert rows_of(files, "cameras.txt") == [
        ["1", "PINHOLE", "640", "480", "500", "510", "320.5", "238.5"],
        ["2", "PINHOLE", "600", "400", "400", "400", "300.5", "200.5"],
    ]
    images = rows_of(files, "images.txt")
    assert [row[8] for row in images[::2]] == ["1", "2", "1", "2", "1"]
    pixels = np.array(images[1]).reshape(-1, 3)[:, :2].astype(float)
    np.testing.assert_allclose(pixels, version.keyframes[0].pixels + 0.5, atol=1e-4)


def test_each_point_has_the_features_that_see_it_and_they_name_it() -> None:
    version, world = points_map()

    files = encode_colmap(version)

    images = [np.array(row).reshape(-1, 3) for row in rows_of(files, "images.txt")[1::2]]
    points = rows_of(files, "points3D.txt")
    assert len(points) == len(world)
    for row in points:
        point = np.array(row[1:4], dtype=float)
        nearest = np.linalg.norm(world - point, axis=1)
        assert nearest.min() < 1e-4
        assert row[4:7] == ["200", "100", "50"]
        track = np.array(row[8:], dtype=int).reshape(-1, 2)
        assert track[:, 0].tolist() == [1, 2, 3, 4, 5]
        for image, feature in track:
            assert images[image - 1][feature, 2] == row[0]
            seen = version.keyframes[image - 1]
            T = seen.T_world_camera
            at = T[:3, :3] @ seen.points_camera[feature] + T[:3, 3]
            np.testing.assert_allclose(at, world[nearest.argmin()], atol=1e-5)


def test_pixels_correct_measured_points_that_are_two_pixels_aside() -> None:
    version, world = points_map()
    aside = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.004, 0.0, 1.0]])  # the focal length is 500 px
    moved = [replace(each, points_camera=each.points_camera @ aside) for each in version.keyframes]

    tracks = find_tracks(replace(version, keyframes=tuple(moved)))

    assert len(tracks.points) == len(world)
    assert tracks.error_px.max() < 1.0


def test_keyframes_far_apart_in_time_are_matched_where_an_edge_links_them() -> None:
    version, _ = points_map(keyframes=12)
    first, last = version.keyframes[0], version.keyframes[-1]
    version = replace(version, keyframes=(first, *version.keyframes[5:8], last))
    alone = [replace(keyframe, robot=f"robot-{n}") for n, keyframe in enumerate(version.keyframes)]
    edge = Edge(
        a=first.id,
        b=last.id,
        T_a_b=inverse(first.T_world_camera) @ last.T_world_camera,
        information=np.eye(6),
        kind="loop",
    )
    assert not len(find_tracks(MapVersion(keyframes=tuple(alone))).points)

    tracks = find_tracks(MapVersion(keyframes=tuple(alone), edges=(edge,)))

    assert set(tracks.keyframe.tolist()) == {0, 4}
    assert len(tracks.points) > 50


@pytest.mark.parametrize("robot", ["a\nb 1 2", "\u202e\x1b[31m", "../../x", ".", "", "x" * 64])
def test_names_of_images_are_plain_and_unique_whatever_a_robot_is_called(robot: str) -> None:
    version, _ = points_map(robot=robot)

    rows = rows_of(encode_colmap(version), "images.txt")

    names = [row[9] for row in rows[::2]]
    assert {len(row) for row in rows[::2]} == {10}
    assert len(set(names)) == 5
    assert all(name.replace("-", "").replace(".", "").replace("_", "").isalnum() for name in names)
    assert not any(name.startswith((".", "-")) for name in names)


def test_absurd_points_and_poses_cost_only_their_own_features() -> None:
    version, world = points_map()
    first = version.keyframes[0]
    points = first.points_camera.copy()
    points[:10] = [[1e30, 1, 1], [1, 1, -5], [np.inf, 0, 1], [np.nan] * 3, [0, 0, 0]] * 2
    pixels = first.pixels.copy()
    pixels[10:20] = 9e4
    far = version.keyframes[4].T_world_camera.copy()
    far[:3, 3] = 9e8
    version = replace(
        version,
        keyframes=(
            replace(first, points_camera=points, pixels=pixels),
            *version.keyframes[1:4],
            replace(version.keyframes[4], T_world_camera=far),
        ),
    )

    tracks = find_tracks(version)

    assert len(tracks.points) == len(world)
    assert np.isfinite(tracks.points).all()
    assert 4 not in tracks.keyframe
    assert not set(tracks.feature[tracks.keyframe == 0].tolist()) & set(range(10, 20))


def test_pycolmap_reads_the_model_of_a_rendered_world(tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    pytest.importorskip("pycolmap", reason=NO_PYCOLMAP)
    compare_with_pycolmap(world_map(), tmp_path)


def compare_with_pycolmap(version: MapVersion, folder: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason=NO_PYCOLMAP)
    for name, data in encode_colmap(version).items():
        (folder / name).write_bytes(data)

    model = pycolmap.Reconstruction(str(folder))

    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() <= 1.5
    assert model.num_images() == len(version.keyframes)
    assert model.num_points3D() > 50 * len(version.keyframes)
    for number, keyframe in enumerate(version.keyframes, start=1):
        pose = model.image(number).cam_from_world().matrix()
        np.testing.assert_allclose(pose, inverse(keyframe.T_world_camera)[:3], atol=1e-6)
