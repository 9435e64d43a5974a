"""Single-file exports hold the content of the map in the conventions of other programs."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.single_files import encode_single_file
from rse_pf.geometry import transform
from rse_pf.slam.ply import decode_ply
from rse_pf.slam.pose_graph import read_g2o
from tests.kit.sample_maps import make_map


def test_the_g2o_file_holds_the_pose_graph_of_the_map() -> None:
    version = make_map()

    graph = read_g2o(encode_single_file(version, "g2o").decode().replace("FIX 0\n", ""))

    assert graph.ids.tolist() == [0, 10, 20, 30]
    np.testing.assert_allclose(graph.T_a_b[1], version.edges[1].T_a_b, atol=1e-7)
    np.testing.assert_allclose(graph.information[1], version.edges[1].information, atol=1e-6)
    np.testing.assert_allclose(graph.T_world_pose[2], version.keyframes[2].T_world_camera, atol=1e-7)


def test_the_clouds_hold_every_point_with_its_colour() -> None:
    version = make_map()

    points, colours = decode_ply(encode_single_file(version, "ply"))
    np.testing.assert_array_equal(points, version.points)
    np.testing.assert_array_equal(colours, version.colours)

    head, _, body = encode_single_file(version, "pcd").partition(b"DATA binary\n")
    packed = np.frombuffer(body, dtype=[("xyz", "<f4", (3,)), ("rgb", "<u4")])
    assert b"POINTS 20" in head
    np.testing.assert_array_equal(packed["xyz"], version.points)
    np.testing.assert_array_equal(packed["rgb"] >> 16, version.colours[:, 0])
    np.testing.assert_array_equal(packed["rgb"] & 255, version.colours[:, 2])


def test_the_trajectory_of_one_robot_is_sorted_by_time() -> None:
    version = make_map()
    rows = np.loadtxt(encode_single_file(version, "tum", "robot-2").decode().splitlines())

    np.testing.assert_allclose(rows[:, 0], [101.0, 103.0])
    np.testing.assert_allclose(
        rows[0, 1:4], transform(version.keyframes[1].T_world_camera, np.zeros((1, 3)))[0]
    )
    with pytest.raises(UsageError):
        encode_single_file(version, "tum", "robot-7")
    with pytest.raises(UsageError):
        encode_single_file(version, "obj")
