"""What a drive remembers of its stereo keyframes: enough to move its cloud with them, and no more."""

import numpy as np

from client_sdk.point_map import MapOptions, PointMap
from client_sdk.tracking.segments import KeyframePoints, SegmentRecord
from client_sdk.tracking.stereo_adjustment import MAX_ADJUSTED_KEYFRAMES, StereoAdjustment


def points_of_keyframes(count: int) -> list[KeyframePoints]:
    points, colours = np.array([[0.0, 0.0, 2.0]], np.float32), np.zeros((1, 3), np.uint8)
    return [KeyframePoints(float(number), np.eye(4), points, colours) for number in range(count)]


def record(count: int) -> SegmentRecord:
    made = SegmentRecord(cloud=PointMap(MapOptions()))
    for points in points_of_keyframes(count):
        made.add_keyframe_points([points])
    return made


def test_points_of_keyframes_are_forgotten_once_they_are_too_many_to_be_adjusted() -> None:
    most, too_many = record(MAX_ADJUSTED_KEYFRAMES), record(MAX_ADJUSTED_KEYFRAMES + 1)

    assert len(most.keyframe_points or ()) == MAX_ADJUSTED_KEYFRAMES
    assert too_many.keyframe_points is None
    too_many.add_keyframe_points(points_of_keyframes(1))
    assert too_many.keyframe_points is None, "a part of them would replace the whole cloud"


def test_two_segments_that_are_joined_count_together() -> None:
    into = record(MAX_ADJUSTED_KEYFRAMES)
    into.append(record(1), np.eye(4))
    fresh = record(0)
    fresh.append(record(MAX_ADJUSTED_KEYFRAMES + 1), np.eye(4))

    assert into.keyframe_points is None
    assert fresh.keyframe_points is None


def test_a_cloud_whose_points_were_forgotten_stays_as_it_is() -> None:
    whole = record(MAX_ADJUSTED_KEYFRAMES + 1)
    whole.cloud.add_points(np.array([[1.0, 2.0, 3.0]]), np.zeros((1, 3), np.uint8))
    found = StereoAdjustment(
        stamps_s=np.arange(2.0), T_new_old=np.tile(np.eye(4), (2, 1, 1)), f_baseline=60.0, offset_px=0.3,
        deviation_px=0.01, bend_m_per_px=0.05, growth_per_px=-0.1, noise_m=0.001,
    )  # fmt: skip

    corrected = whole.corrected(found)

    assert corrected.keyframe_points is None
    assert corrected.cloud is whole.cloud
