"""Links of wide baselines in the red kitchen: enough are believed and right, and none is wrong.

The drive is divided into two robots: one drives all of it before the other, so that its keyframes lie a gap
of frames away from those that they are compared with.  Each phase of the keyframes is a run of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from client_sdk.frontend import FrontEndOptions, describe, points_at
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.live_map.events import KeyframeAdded, LinksMeasured, MeasuredLink, matrix_bytes
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.options import LiveMapOptions
from rse_pf.pnp import DepthNoise
from rse_pf.slam.keyframe import Keyframe, encode_keyframe, make_features
from rse_pf.slam.relative_pose import Reference, RelativePose, View, measure_link
from tests.recorded_drives import red_kitchen, track, truth_of

pytestmark = [pytest.mark.data, pytest.mark.slow]

for package in ("cv2", "faiss"):
    pytest.importorskip(package)

GAP, SPACING = 20, 5  # frames between the ends of a pair, and from one keyframe to the next
FEATURES, SENT = 1000, 870
OPTIONS = LiveMapOptions()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """One frame: its points, its image, its pose by odometry and its true one."""

    reference: Reference
    view: View
    T_odom_camera: Array
    T_world_camera: Array

    def keyframe(self, robot: str, number: int) -> KeyframeAdded:
        """Return a keyframe at the pose of its odometry; its features are not asked for."""
        features = make_features(np.array([[1.0, 1.0]]), np.ones(1), np.zeros((1, 32), dtype=np.uint8))
        keyframe = Keyframe(
            timestamp_s=float(number),
            T_odom_camera=self.T_odom_camera,
            camera=self.view.camera,
            features=features,
        )
        return KeyframeAdded(robot=robot, segment=0, number=number, data=encode_keyframe(keyframe))


def kitchen_sights(recordings: Path) -> list[Sight]:
    dataset, options = red_kitchen(recordings), FrontEndOptions.live()
    tracker, sights = Tracker(options), []
    for frame in dataset:
        step = track(tracker, frame)
        if step.T_world_camera is None:
            continue
        found = describe(frame.rgb, FEATURES, is_spread=False)
        points = points_at(frame, found.pixels, options)
        rows = np.flatnonzero(np.isfinite(points[:, 2]))[:SENT]
        pixels, descriptors, points = found.pixels[rows], found.descriptors[rows], points[rows]
        view = View(
            camera=frame.camera,
            pixels=pixels,
            descriptors=descriptors,
            depths_m=points[:, 2],
            noise=DepthNoise(),
        )
        sights.append(
            Sight(
                reference=Reference(points_camera=points, descriptors=descriptors),
                view=view,
                T_odom_camera=step.T_world_camera,
                T_world_camera=truth_of(dataset, [frame.timestamp_s])[0],
            )
        )
    return sights


def believed_errors(sights: Sequence[Sight], phase: int) -> tuple[int, list[tuple[float, float]]]:
    """Return how many pairs were measured, and the errors (m, deg) of the links that a live map believes."""
    first = range(phase, len(sights), SPACING)
    second = range(phase + GAP, len(sights), SPACING)
    rows, live_map = [*first, *second], LiveMap(OPTIONS)
    for number, row in enumerate(first):
        live_map.apply(sights[row].keyframe("first", number))
    for number, row in enumerate(second):
        live_map.apply(sights[row].keyframe("second", number))
        link = measure_link(sights[row].reference, sights[row - GAP].view, OPTIONS.measured)
        if isinstance(link, RelativePose):
            measured = MeasuredLink(
                other=first.index(row - GAP),
                T_keyframe_other=matrix_bytes(link.T_a_b),
                information=matrix_bytes(link.information),
                inliers=link.inliers,
                matches=link.matches,
            )
            live_map.apply(LinksMeasured(keyframe=len(first) + number, links=(measured,)))
    return len(second), [
        pose_difference(T, inverse(sights[rows[a]].T_world_camera) @ sights[rows[b]].T_world_camera)
        for a, b, T in live_map.believed()
    ]


def test_a_seventh_of_the_pairs_two_seconds_apart_is_believed_and_right(recordings: Path) -> None:
    sights = kitchen_sights(recordings)
    runs = [believed_errors(sights, phase) for phase in range(SPACING)]
    pairs, errors = sum(count for count, _ in runs), [error for _, found in runs for error in found]

    assert pairs == 230
    assert sum(metres <= 0.05 and degrees <= 5.0 for metres, degrees in errors) >= 0.15 * pairs
    assert not [error for error in errors if error[0] > 0.3 or error[1] > 10.0]
