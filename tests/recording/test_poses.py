"""Poses become Foxglove's messages without numpy, and equal what numpy says."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.extensions.recording.poses import read_answered_pose
from rse_pf.services.pnp import PnpReply
from rse_pf.wire import Result, make_codec


@pytest.mark.parametrize("codec", ["json", "bin"])
def test_the_pose_of_an_answer_is_read_from_its_bytes(codec: str):
    pose = np.arange(16.0)
    reply = PnpReply(
        T_camera_world=pose, inliers=np.arange(3), rmse_px=0.5, covariance=np.zeros(21), verdict="ok"
    )

    data = make_codec(codec).encode(Result(id=1, reply=reply))

    assert read_answered_pose(data, is_binary=codec == "bin") == pytest.approx(pose.tolist())
