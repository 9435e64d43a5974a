"""The keyframes of a robot: each is kept for its map and sent once."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.frontend import Frame, FrontEndOptions, TrackedFrame
from rse_pf.extensions.experiments.demo.keyframes import KeyframeCollector
from rse_pf.geometry import Camera
from rse_pf.maps.format import decode_map, encode_map

pytest.importorskip("cv2", reason="the extra vision is needed")

CAMERA = Camera(fx=200.0, fy=200.0, cx=159.5, cy=119.5, width=320, height=240)


def tracked(*, keyframe: bool, seed: int = 0) -> TrackedFrame:
    rgb = np.kron(np.random.default_rng(seed).integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(
        np.uint8
    )
    frame = Frame(timestamp_s=1.5, rgb=rgb, depth_m=np.full((240, 320), 2.0, np.float32), camera=CAMERA)
    return TrackedFrame(frame=frame, T_world_camera=np.eye(4), keyframe=keyframe, inliers=9, matches=9)


class RecordingSink:
    """Stands in for the data service."""

    def __init__(self) -> None:
        self.keyframes: list[bytes] = []
        self.maps: dict[str, bytes] = {}

    def keyframe(self, data: bytes) -> None:
        self.keyframes.append(data)

    def finish(self, robot: str, data: bytes) -> int:
        self.maps[robot] = data
        return len(self.keyframes)


def test_keyframes_are_kept_for_the_map_and_sent_once() -> None:
    sink = RecordingSink()
    collector = KeyframeCollector("robot-1", FrontEndOptions(), sink)

    for step in (tracked(keyframe=True), tracked(keyframe=False, seed=1), tracked(keyframe=True, seed=2)):
        collector.add(step)

    assert len(collector) == len(sink.keyframes) == 2
    version = decode_map(collector.encoded_map(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)))
    assert [each.id for each in version.keyframes] == [0, 1]
    assert version.provenance["robot"] == "robot-1"
    (sent,) = decode_map(sink.keyframes[1]).keyframes
    assert len(sent.pixels) > 50
    np.testing.assert_array_equal(sent.descriptors, version.keyframes[1].descriptors)
    np.testing.assert_allclose(sent.points_camera[:, 2], 2.0, atol=1e-4)

    whole = encode_map(version)
    uploaded = collector.share(whole)

    assert sink.maps == {"robot-1": whole}
    assert uploaded == 2
