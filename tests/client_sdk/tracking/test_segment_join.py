"""Segments that wheels connect: what the wheels say about where one lies in the other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from client_sdk.tracking.segment_join import WheelConnection, connections_between, is_join_expected
from client_sdk.wheel_odometry import WheelMotion
from rse_pf.geometry import planar_pose


def connection(length_m: float) -> WheelConnection:
    """Return a straight motion by wheels that ends at the origin."""
    pose = planar_pose(length_m, 0.0, 0.0)
    motion = WheelMotion(T_begin_end=pose, T_camera_begin_end=pose, length_m=length_m, angle_rad=0.0)
    return WheelConnection(position=np.zeros(3), motion=motion)


@pytest.mark.parametrize(
    ("lengths_m", "shift_m", "turn_deg", "here_m", "is_expected"),
    [
        ((4.0,), 0.5, 0.0, 0.0, True),
        ((4.0,), 1.0, 0.0, 0.0, False),
        ((4.0,), 1.0, 0.0, 5.0, True),  # a wrong heading moves what is far from the begin of the segment
        ((4.0,), 0.0, 10.0, 0.0, True),
        ((4.0,), 0.0, 25.0, 0.0, False),
        ((4.0, 4.0), 1.0, 25.0, 0.0, True),
        ((4.0, 4.0), 1.0, 40.0, 0.0, False),
        ((4.0, 4.0), 2.0, 0.0, 0.0, False),
    ],
)
def test_wheels_allow_joins_within_three_standard_deviations(
    lengths_m: tuple[float, ...], shift_m: float, turn_deg: float, here_m: float, is_expected: bool
) -> None:
    T_other_present = planar_pose(shift_m, 0.0, math.radians(turn_deg))
    here = np.array([here_m, 0.0, 0.0])

    found = is_join_expected(map(connection, lengths_m), T_other_present, here)

    assert found == is_expected


@pytest.mark.parametrize(
    ("first", "second", "expected"), [(0, 3, [1, 2, 3]), (3, 1, [2, 3]), (2, 4, [2, 4]), (2, 2, [])]
)
def test_connections_that_both_segments_have_in_common_do_not_count(
    first: int, second: int, expected: list[int]
) -> None:
    anchors = {1: 0, 2: 1, 3: 2, 4: 1}

    assert connections_between(anchors, first, second) == expected
