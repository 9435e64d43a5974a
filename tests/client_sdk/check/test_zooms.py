"""Focal lengths of keyframes: two cameras, a lens that focuses, and what is only noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client_sdk.check.findings import FaultKind
from client_sdk.check.zooms import check_zooms
from rse_pf.geometry import Array
from rse_pf.slam.self_calibration import UNKNOWNS, Calibrated

VIEWS = 20


def adjusted(zooms: Array, deviation: float) -> Calibrated:
    """Return a drive along x with these zooms, each known with the same deviation."""
    T = np.tile(np.eye(4), (VIEWS, 1, 1))
    T[:, 0, 3] = -0.1 * np.arange(VIEWS)
    n = len(UNKNOWNS)
    return Calibrated(
        values=np.zeros(n), covariance=np.zeros((n, n)), zooms=zooms,
        zooms_covariance=deviation**2 * np.eye(VIEWS), T_camera_world=T, points_world=np.zeros((1, 3)),
        bends_m=np.zeros((n, VIEWS, 3)), noise_m=0.0, has_metric_scale=True, depth_factor=1.0,
    )  # fmt: skip


HALVES = np.where(np.arange(VIEWS) // 5 % 2 == 0, 0.05, -0.05)
RAMP = np.linspace(-0.04, 0.04, VIEWS)


WANDERING = 0.04 * np.sin(np.linspace(0.0, 5.0, VIEWS))


STAIRS = np.repeat([-0.06, 0.0, 0.06, 0.12], 5)


@pytest.mark.parametrize(
    ("zooms", "kind", "value"),
    [
        (HALVES, FaultKind.TWO_CAMERAS, np.expm1(0.1)),
        (RAMP, FaultKind.MOVING_FOCAL_LENGTH, np.expm1(0.08)),
    ],
)
def test_a_focal_length_that_is_not_the_same_is_found_where_it_is_known(
    zooms: Array, kind: FaultKind, value: float
) -> None:
    common, times_s = adjusted(np.zeros(VIEWS), 0.01), np.arange(VIEWS) / 2.0

    found = check_zooms(adjusted(zooms, 0.001), times_s, common).finding

    assert found is not None
    assert (found.kind, found.value) == (kind, pytest.approx(value, rel=0.02))
    assert check_zooms(adjusted(zooms, 0.2), times_s, common).finding is None


@pytest.mark.parametrize(
    ("zooms", "said"),
    [(WANDERING, "parts of the drive say"), (STAIRS, "neither two cameras nor a lens that focuses")],
)
def test_a_focal_length_that_errors_of_depth_move_is_no_finding_and_this_is_said(
    zooms: Array, said: str
) -> None:
    times_s = np.arange(VIEWS) / 2.0

    judged = check_zooms(adjusted(zooms, 0.001), times_s, adjusted(np.zeros(VIEWS), 0.001))

    assert judged.finding is None
    assert said in judged.cannot_tell[0].reason


def test_a_drive_without_depth_does_not_blame_depth() -> None:
    common, times_s = adjusted(np.zeros(VIEWS), 0.01), np.arange(VIEWS) / 2.0
    reasons = [
        check_zooms(adjusted(WANDERING, 0.001), times_s, replace(common, has_metric_scale=has))
        .cannot_tell[0]
        .reason
        for has in (True, False)
    ]

    assert ["of depth" in reason for reason in reasons] == [True, False]
