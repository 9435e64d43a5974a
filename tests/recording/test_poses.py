"""Poses become Foxglove's messages without numpy, and equal what numpy says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rse_pf.extensions.recording.file_format import POINTS_SCHEMA, POSE_SCHEMA, SCHEMAS, encode_json
from rse_pf.extensions.recording.poses import inverse, point_cloud, pose_in_frame, read_answered_pose
from rse_pf.services.pnp import PnpReply
from rse_pf.wire import Result, make_codec


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q if np.linalg.det(q) > 0 else -q


def matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


HALF_TURNS = [np.diag(signs).astype(float) for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1), (1, 1, 1))]


@pytest.mark.parametrize("R", [*map(rotation, range(20)), *HALF_TURNS])
def test_the_quaternion_is_that_of_the_rotation(R: np.ndarray):
    T = np.eye(4)
    T[:3, :3] = R

    told = pose_in_frame(T.ravel().tolist(), 1)["pose"]["orientation"]

    np.testing.assert_allclose(matrix(**told), R, atol=1e-12)


def test_the_inverse_maps_the_camera_to_the_world():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(3), (1, 2, 3)

    np.testing.assert_allclose(np.reshape(inverse(T.ravel().tolist()), (4, 4)), np.linalg.inv(T), atol=1e-12)


@pytest.mark.parametrize("codec", ["json", "bin"])
def test_the_pose_of_an_answer_is_read_from_its_bytes(codec: str):
    pose = np.arange(16.0)
    reply = PnpReply(
        T_camera_world=pose, inliers=np.arange(3), rmse_px=0.5, covariance=np.zeros(21), verdict="ok"
    )

    data = make_codec(codec).encode(Result(id=1, reply=reply))

    assert read_answered_pose(data, is_binary=codec == "bin") == pytest.approx(pose.tolist())


@pytest.mark.parametrize(
    "reply", [None, {}, {"T_camera_world": [1.0] * 15}, {"T_camera_world": ["a"] * 16}, 7]
)
@pytest.mark.parametrize("codec", ["json", "bin"])
def test_an_answer_without_a_pose_gives_none(codec: str, reply: object):
    data = make_codec(codec).encode(Result(id=1, reply=reply))

    assert read_answered_pose(data, is_binary=codec == "bin") is None


@pytest.mark.parametrize(
    ("schema", "message"),
    [
        (POSE_SCHEMA, pose_in_frame([*np.eye(4).ravel()], 1_500_000_000)),
        (POINTS_SCHEMA, point_cloud(np.zeros((2, 3), "<f4").tobytes(), 1)),
    ],
)
def test_a_message_has_the_fields_of_its_schema(schema: str, message: dict[str, object]):
    described = json.loads(SCHEMAS[schema])["properties"]

    assert set(json.loads(encode_json(message))) == set(described)
