"""Tests of the adjustment of keyframes with their calibration, on exact points with exact noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, exp_se3, inverse
from rse_pf.slam.self_calibration import (
    UNKNOWNS,
    Calibrated,
    DriveObservations,
    adjust_with_calibration,
    disagreement,
    triangulate_landmarks,
)

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
VIEWS, POINTS = 16, 250
PLANTED = {
    "fx": 0.05, "fy": -0.04, "cx": 12.0, "cy": -9.0, "k1": 0.08, "offset": 0.04, "delay": 0.05,
    "readout": 0.015, "curve": 0.004,
}  # fmt: skip


def made(
    seed: int, values: Array, *, zooms: Array | None = None, has_depth: bool = True
) -> tuple[DriveObservations, Array]:
    """Return what a camera with *values* beside the set one sees of random points, and its true poses."""
    rng = np.random.default_rng([seed, 5])
    points = rng.uniform(-1.0, 1.0, (POINTS, 3)) * (1.6, 1.2, 1.0) + (0.0, 0.0, 2.6)
    twists = rng.uniform(-1.0, 1.0, (VIEWS, 6)) * (0.5, 0.4, 0.5, 0.25, 0.25, 0.3)
    T = exp_se3(twists)
    rates = rng.uniform(-1.0, 1.0, (VIEWS, 6)) * 0.4
    keyframes, landmarks = np.divmod(np.arange(VIEWS * POINTS), POINTS)
    seen = np.einsum("nij,nj->ni", T[keyframes, :3, :3], points[landmarks]) + T[keyframes, :3, 3]
    a, b, cx, cy, k1, offset, delay, readout, curve = values
    zoom = np.ones(VIEWS) if zooms is None else np.exp(zooms)
    x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    bent = 1.0 + k1 * (x * x + y * y)
    pixels = np.stack(
        [
            CAMERA.fx * np.exp(a) * zoom[keyframes] * x * bent + CAMERA.cx + cx,
            CAMERA.fy * np.exp(b) * zoom[keyframes] * y * bent + CAMERA.cy + cy,
        ],
        axis=1,
    )
    moved = rates[keyframes, :3] + np.cross(rates[keyframes, 3:], seen)
    later = seen + readout * (pixels[:, 1:] / CAMERA.height - 0.5) * moved
    pixels[:, 0] += CAMERA.fx * (later[:, 0] / later[:, 2] - x)
    pixels[:, 1] += CAMERA.fy * (later[:, 1] / later[:, 2] - y)
    depth_rates = rng.normal(0.0, 0.3, len(seen))
    depths = seen[:, 2] + offset + curve * seen[:, 2] ** 2 - depth_rates * delay
    depths += 0.01 * rng.standard_normal(len(depths))
    pixels += 0.5 * rng.standard_normal(pixels.shape)
    inside = (seen[:, 2] > 0.3) & ((pixels > 0) & (pixels < (640, 480))).all(axis=1)
    rows = np.flatnonzero(inside)
    wrong = rng.choice(rows, len(rows) // 50, replace=False)
    pixels[wrong] += rng.uniform(-60.0, 60.0, (len(wrong), 2))
    observed = DriveObservations(
        camera=CAMERA, keyframes=keyframes[rows], landmarks=landmarks[rows], pixels=pixels[rows],
        pixel_deviations_px=np.full(len(rows), 0.5),
        depths_m=depths[rows] if has_depth else np.full(len(rows), np.nan),
        depth_deviations_m=np.full(len(rows), 0.01), rates_m_s=depth_rates[rows], twists_s=rates,
    )  # fmt: skip
    return observed, T


def adjusted(seed: int, values: Array, **options: object) -> Calibrated:
    observed, T = made(seed, values)
    near = exp_se3(0.005 * np.random.default_rng(seed).standard_normal((VIEWS, 6))) @ T
    return adjust_with_calibration(
        observed, near, triangulate_landmarks(observed, near, POINTS), UNKNOWNS, **options
    )  # type: ignore[arg-type]


def planted() -> Array:
    return np.array([PLANTED[name] for name in UNKNOWNS])


def test_values_lie_within_three_of_their_deviations_over_many_drives() -> None:
    values = planted()
    off = np.array(
        [(each.values - values) / each.deviations for each in (adjusted(seed, values) for seed in range(8))]
    )

    assert (np.abs(off) < 3.0).mean() >= 0.97
    assert np.abs(off).max() < 4.5
    # Nor are the deviations so wide that they would tell nothing.
    assert np.sqrt((off**2).mean()) > 0.4


def test_deviations_are_small_where_the_drive_tells() -> None:
    found = adjusted(8, planted())

    limits = np.array([0.006, 0.006, 3.0, 3.0, 0.006, 0.03, 0.004, 0.006, 0.004])
    assert (found.deviations < limits).all()


def test_a_good_calibration_is_found_good() -> None:
    found = adjusted(3, np.zeros(len(UNKNOWNS)))

    assert (np.abs(found.values) < 3.5 * found.deviations).all()
    assert found.deviations[UNKNOWNS.index("fx")] < 0.005


def test_what_is_not_free_stays_and_has_no_deviation() -> None:
    observed, T = made(1, planted())

    found = adjust_with_calibration(observed, T, triangulate_landmarks(observed, T, POINTS), ("fx", "k1"))

    held = [row for row, name in enumerate(UNKNOWNS) if name not in ("fx", "k1")]
    assert not found.values[held].any()
    assert not found.covariance[held].any()


def test_each_view_gets_its_focal_length() -> None:
    zooms = np.where(np.arange(VIEWS) % 3 == 0, 0.08, -0.04)
    zooms -= zooms.mean()
    observed, T = made(2, np.zeros(len(UNKNOWNS)), zooms=zooms)

    found = adjust_with_calibration(
        observed, T, triangulate_landmarks(observed, T, POINTS), UNKNOWNS, zooms=True
    )

    deviations = np.sqrt(np.diag(found.zooms_covariance))
    assert (np.abs(found.zooms - zooms) < 4.0 * deviations + 0.003).all()


def test_without_depth_the_focal_length_comes_from_the_rays() -> None:
    values = np.where(np.array(UNKNOWNS) == "fx", 0.05, 0.0)
    observed, T = made(4, values, has_depth=False)

    found = adjust_with_calibration(
        observed, T, triangulate_landmarks(observed, T, POINTS), ("fx", "fy", "cx", "cy", "k1")
    )

    assert abs(found.values[0] - 0.05) < 3.5 * found.deviations[0] < 0.03
    assert not found.has_metric_scale


def test_the_bend_of_a_wrong_focal_length_is_what_an_adjustment_with_it_shows() -> None:
    observed, T = made(5, np.zeros(len(UNKNOWNS)))
    points = triangulate_landmarks(observed, T, POINTS)
    free = adjust_with_calibration(observed, T, points, UNKNOWNS)
    wrong = replace(observed, camera=Camera(fx=510.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480))
    others = tuple(name for name in UNKNOWNS if name != "fx")

    bent = adjust_with_calibration(wrong, T, points, others)

    error = np.where(np.array(UNKNOWNS) == "fx", np.log(510.0 / 500.0), 0.0)
    at, there = (inverse(each.T_camera_world)[:, :3, 3] for each in (free, bent))
    at, there = at - at.mean(axis=0), there - there.mean(axis=0)
    U, _, Vt = np.linalg.svd(at.T @ there)
    apart = float(np.sqrt(np.square(at - there @ (U @ Vt).T).sum(axis=1).mean()))
    assert free.bend_m(error) == pytest.approx(apart, rel=0.4)


def test_the_same_drive_gives_the_same_numbers() -> None:
    one, other = adjusted(6, planted()), adjusted(6, planted())

    np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_what_does_not_fit_is_refused_in_one_line() -> None:
    observed, T = made(7, planted())
    with pytest.raises(BadRequest, match="no unknown named"):
        adjust_with_calibration(observed, T, np.zeros((POINTS, 3)), ("zoom",))
    with pytest.raises(BadRequest, match="observations have the shapes"):
        replace(observed, pixels=observed.pixels[:3])


def test_parts_that_disagree_by_more_than_they_know_add_a_deviation() -> None:
    """By hand: equal weights, squares about the mean of 2, one degree of freedom, between 0.02 - 0.01."""
    values = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.2]])
    variances = np.array([[0.01, 0.01, 1.0], [0.01, 0.01, 1.0]])

    told = disagreement(values, variances)

    np.testing.assert_allclose(told, [np.sqrt(0.01 / 2), 0.0, 0.0], atol=1e-12)
