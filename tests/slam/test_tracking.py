"""A tracker's functions agree with their definition, poses with the truth; wrong input is refused."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, exp_se3, inverse, log_se3, transform
from rse_pf.slam.descriptors import measure_distinctiveness
from rse_pf.slam.tracking import (
    Features,
    FittedPose,
    GuidedMatchLimits,
    LandmarkAppearance,
    Observations,
    PredictedFeatures,
    fit_pose,
    fit_readout_change,
    match_landmarks,
    match_predictions,
    predict_features,
)
from tests.oracles import matching, pose_fit

CAMERA = Camera(fx=525.0, fy=520.0, cx=319.5, cy=239.5, width=640, height=480)


# --- Landmarks near the pixels that a pose predicts ---


def landmarks_of(rng: np.random.Generator, n: int) -> LandmarkAppearance:
    """Return landmarks around a camera at the origin, seen before from cameras near and far from it."""
    points = rng.uniform((-3.0, -3.0, -1.0), (3.0, 3.0, 6.0), (n, 3))
    points[rng.random(n) < 0.05] = np.nan
    angle = rng.uniform(-0.5, 0.5, n)
    return LandmarkAppearance(
        points=points, rays=points * rng.choice([0.3, 0.9, 1.1, 3.0, -1.0], (n, 1)),
        orientations=np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle]),
        sizes=rng.choice([1.0, 1.2, 2.0], n), descriptors=descriptors_of(rng, n, n // 3 + 1),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
def test_landmarks_are_matched_where_a_pose_predicts_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    landmarks = landmarks_of(rng, 400)
    T = exp_se3(rng.normal(0.0, 0.1, 6))
    _, seen = predict_features(landmarks, np.arange(400), T, CAMERA, 10.0)
    shown = rng.permutation(len(seen.pixels))[:100]
    image = Features(
        pixels=seen.pixels[shown] + rng.normal(0.0, 3.0, (len(shown), 2)),
        descriptors=seen.descriptors[shown], orientations=seen.orientations[shown],
        sizes=seen.sizes[shown], points_camera=np.full((len(shown), 3), np.nan),
        distinctiveness=np.full(len(shown), 256, dtype=np.int32),
        is_oriented=seed % 2 == 0, is_scaled=seed % 3 == 0,
    )  # fmt: skip
    numbers = np.sort(rng.choice(400, 300, replace=False))
    limits = GuidedMatchLimits(radius_px=8.0)

    rows, features = match_landmarks(landmarks, numbers, T, CAMERA, image, limits, 10.0)

    predicted_rows, predicted = predict_features(landmarks, numbers, T, CAMERA, 10.0)
    sought, columns = matching.match_predictions(predicted, image, limits)
    assert len(rows) > 5
    np.testing.assert_array_equal(rows, predicted_rows[sought])
    np.testing.assert_array_equal(features, columns)


# --- Matches of predicted features ---


def places(rng: np.random.Generator, n: int, kind: str) -> Array:
    """Return pixels: on a coarse lattice, anywhere, at borders of cells, outside, or no numbers."""
    if kind == "lattice":
        return rng.integers(0, 12, (n, 2)) * 8.0
    if kind == "cells":
        edges = rng.integers(-3, 70, (n, 2)) * 40.0
        return np.nextafter(edges, rng.choice([-np.inf, np.inf], (n, 2))) if n % 2 else edges
    pixels = rng.uniform((-60.0, -60.0), (700.0, 540.0), (n, 2))
    if kind == "outside":
        pixels = pixels * 10.0 ** rng.integers(-1, 8, (n, 1)) * rng.choice([-1, 1], (n, 2))
    if kind == "strange":
        strange = rng.random((n, 2)) < 0.2
        pixels[strange] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 2e9, 0.0], strange.sum())
    return pixels


def descriptors_of(rng: np.random.Generator, n: int, distinct: int) -> npt.NDArray[np.uint8]:
    """Return descriptors with many equal ones, and many at equal distances."""
    known = np.random.default_rng(3).integers(0, 256, (distinct, 32), dtype=np.uint8)
    bits = known[rng.integers(0, distinct, n)]
    bits[np.arange(n), rng.integers(0, 32, n)] ^= rng.choice(np.uint8([0, 1, 7, 255]), n)
    return bits


def angles(rng: np.random.Generator, n: int) -> Array:
    turn = rng.choice([0.0, 0.1, 0.4, 3.0], n) + rng.choice([0.0, 0.01], n)
    return np.column_stack([np.cos(turn), np.sin(turn)])


def request_of(seed: int) -> tuple[PredictedFeatures, Features, GuidedMatchLimits]:
    rng = np.random.default_rng(seed)
    m, n = (int(rng.choice([0, 1, 2, 40, 300])) for _ in range(2))
    kind = ("lattice", "anywhere", "cells", "outside", "strange")[seed % 5]
    distinct = int(rng.choice([1, 4, 50, 400]))
    pixels = places(rng, n, kind)
    of = rng.integers(0, max(n, 1), m if n else 0)
    near = pixels[of] if n else places(rng, m, kind)
    offset = rng.choice([0.0, 3.0, 8.0, 40.0, 0.3], (m, 2))
    predicted = np.where(rng.random((m, 1)) < 0.8, near + offset, places(rng, m, kind))
    bits, expected_bits = descriptors_of(rng, n, distinct), descriptors_of(rng, m, distinct)
    like = np.flatnonzero(rng.random(len(of)) < 0.7)
    expected_bits[like] = bits[of[like]]
    expected_bits[like, rng.integers(0, 32, len(like))] ^= rng.choice(np.uint8([0, 1, 7]), len(like))
    sought = PredictedFeatures(
        pixels=predicted, descriptors=expected_bits, orientations=angles(rng, m),
        sizes=1.2 ** rng.integers(0, 4, m),
    )  # fmt: skip
    image = Features(
        pixels=pixels, descriptors=bits, orientations=angles(rng, n), sizes=1.2 ** rng.integers(0, 4, n),
        points_camera=np.full((n, 3), np.nan),
        distinctiveness=matching.measure_distinctiveness(bits, pixels, 6.0).astype(np.int32),
    )  # fmt: skip
    limits = GuidedMatchLimits(
        radius_px=float(rng.choice([0.0, 3.0, 8.0, 40.0, 5000.0, 1e9])),
        lowe_ratio=float(rng.choice([0.8, 1.0, 1.5])), distinctiveness_ratio=float(rng.choice([0.8, 2.0])),
        min_orientation_cosine=float(rng.choice([0.9, -1.0])), max_size_ratio=float(rng.choice([1.35, 9.0])),
        max_distance=int(rng.choice([0, 60, 256])),
    )  # fmt: skip
    return sought, image, limits


def test_matches_and_distances_are_those_of_the_definition() -> None:
    counts, similar = [], 0
    for seed in range(600):
        sought, image, limits = request_of(seed)

        rows, columns = match_predictions(sought, image, limits)
        apart_px = (0.0, 6.0, 40.0, np.nan)[seed % 4]
        distances = measure_distinctiveness(image.descriptors, image.pixels, apart_px)

        expected = matching.match_predictions(sought, image, limits)
        assert (rows.tolist(), columns.tolist()) == tuple(each.tolist() for each in expected), seed
        assert rows.dtype == columns.dtype == np.int64
        assert distances.dtype == np.int32
        of_all = matching.measure_distinctiveness(image.descriptors, image.pixels, apart_px)
        assert distances.tolist() == of_all.tolist()
        counts.append(len(rows))
        similar += int((distances < 256).sum())
    assert counts.count(0) > 50
    assert max(counts) > 30
    assert sum(counts) > 1000
    assert similar > 10_000


def flat(pixels: list[tuple[float, float]], bits: list[int]) -> dict[str, Any]:
    """Return features with *bits* set, upright and of the finest level."""
    descriptors = np.array([[255] * (k // 8) + [(1 << k % 8) - 1] + [0] * (31 - k // 8) for k in bits])
    return {
        "pixels": np.array(pixels, dtype=float).reshape(-1, 2),
        "descriptors": descriptors.astype(np.uint8).reshape(-1, 32),
        "orientations": np.tile([1.0, 0.0], (len(bits), 1)),
        "sizes": np.ones(len(bits)),
    }


def image_of(pixels: list[tuple[float, float]], bits: list[int], distinct: int = 256) -> Features:
    return Features(
        **flat(pixels, bits),
        points_camera=np.full((len(bits), 3), np.nan),
        distinctiveness=np.full(len(bits), distinct, dtype=np.int32),
    )


def matched(sought: dict[str, Any], image: Features, **limits: float) -> list[tuple[int, int]]:
    rows, columns = match_predictions(
        PredictedFeatures(**sought),
        image,
        GuidedMatchLimits(**{"radius_px": 10.0, **limits}),  # type: ignore[arg-type]
    )
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def test_the_nearest_within_the_radius_and_every_limit_is_taken() -> None:
    sought = flat([(100, 100)], [0])

    assert matched(sought, image_of([(106, 108), (100, 111)], [40, 0])) == [(0, 0)]  # 10 px away; 11 px
    assert matched(sought, image_of([(100, 100)], [60])) == [(0, 0)]
    assert matched(sought, image_of([(100, 100)], [61])) == []
    assert matched(sought, image_of([(100, 100), (101, 100)], [39, 50])) == [(0, 0)]
    assert matched(sought, image_of([(100, 100), (101, 100)], [40, 50])) == []  # not clearly the nearest
    assert matched(sought, image_of([(100, 100)], [39], distinct=50)) == [(0, 0)]
    assert matched(sought, image_of([(100, 100)], [40], distinct=50)) == []
    turned = replace(image_of([(100, 100)], [0]), orientations=np.array([[0.8, 0.6]]))
    assert matched(sought, turned) == []
    assert matched(sought, turned, min_orientation_cosine=0.8) == [(0, 0)]
    for size, is_like in ((1.35, True), (1.4, False), (1 / 1.3, True), (0.7, False)):
        assert bool(matched(sought, replace(image_of([(100, 100)], [0]), sizes=np.array([size])))) == is_like


def test_one_feature_goes_to_the_nearest_and_to_the_first_of_equals() -> None:
    image = image_of([(50, 50)], [0])

    assert matched(flat([(50, 50)] * 3, [9, 5, 5]), image) == [(1, 0)]
    assert matched(flat([(50, 50)], [5]), image_of([(50, 51), (50, 50)], [0, 0]), lowe_ratio=1.5) == [(0, 0)]


def test_pixels_that_are_not_finite_match_nothing_and_change_no_other_match() -> None:
    nan, inf = float("nan"), float("inf")
    wrong = [(nan, 5.0), (5.0, nan), (inf, 5.0), (5.0, -inf), (inf, inf), (2e9, 5.0)]
    image = image_of([*wrong, (-300.0, -7.0), (5000.0, 90_000.0)], [0] * 8)

    found = matched(flat([*wrong, (-300.0, -7.0), (5000.0, 90_000.0)], [0] * 8), image)

    assert found == [(6, 6), (7, 7)]
    assert matched(flat([(0.0, 0.0)], [0]), replace(image_of([(0.0, 0.0)], [0]), sizes=np.array([nan]))) == []
    assert matched(flat([(7.5, 2.0)], [0]), image_of([(7.5, 2.0)], [0]), radius_px=0.0) == [(0, 0)]


def test_other_numbers_and_gaps_in_memory_give_the_same() -> None:
    sought, image, limits = next(
        request
        for request in map(request_of, range(1, 600, 5))
        if min(len(request[0].pixels), len(request[1])) > 30
    )
    assert len(sought.pixels)
    assert len(image)
    limits = replace(
        limits,
        radius_px=40.0,
        min_orientation_cosine=-1.0,
        max_size_ratio=9.0,
        max_distance=256,
        lowe_ratio=1.5,
    )
    sought, image = (
        replace(
            each,
            pixels=np.round(each.pixels),
            orientations=np.round(each.orientations),
            sizes=np.ones(len(each.sizes)),
        )
        for each in (sought, image)
    )
    expected = match_predictions(sought, image, limits)

    def other(each: Any, kind: type) -> Any:
        return replace(
            each,
            pixels=np.asfortranarray(each.pixels.astype(kind)),
            orientations=np.repeat(each.orientations.astype(kind), 2, axis=0)[::2],
            sizes=each.sizes[::-1].astype(kind)[::-1],
            descriptors=np.asfortranarray(each.descriptors),
        )

    for kind in (np.float32, np.int64, np.float64):
        changed = replace(other(image, kind), distinctiveness=image.distinctiveness.astype(np.int64))
        found = match_predictions(other(sought, kind), changed, limits)
        assert [each.tolist() for each in found] == [each.tolist() for each in expected]
    np.testing.assert_array_equal(
        measure_distinctiveness(np.asfortranarray(image.descriptors), image.pixels.astype(np.float32)),
        measure_distinctiveness(image.descriptors, image.pixels),
    )


@pytest.mark.parametrize(
    "change",
    [
        {"pixels": np.zeros((3, 2))}, {"pixels": np.zeros((4, 3))}, {"orientations": np.zeros((4, 1))},
        {"sizes": np.zeros((4, 1))}, {"sizes": np.zeros(5)}, {"descriptors": np.zeros((4, 16), np.uint8)},
        {"descriptors": np.zeros((4, 32))}, {"descriptors": np.zeros((4, 32), np.int8)},
        {"distinctiveness": np.zeros(3, np.int32)},
    ],
)  # fmt: skip
def test_features_that_do_not_fit_are_refused(change: dict[str, Array]) -> None:
    spots = [(0.0, 0.0)] * 4
    sought, image = PredictedFeatures(**flat(spots, [0] * 4)), image_of(spots, [0] * 4)

    with pytest.raises(BadRequest, match=r"features|descriptors"):
        match_predictions(sought, replace(image, **change), GuidedMatchLimits(radius_px=3.0))
    if "distinctiveness" not in change:
        with pytest.raises(BadRequest, match=r"features|descriptors"):
            match_predictions(replace(sought, **change), image, GuidedMatchLimits(radius_px=3.0))


def test_the_most_similar_feature_that_is_another_point_counts() -> None:
    features = flat([(10, 10), (13, 10), (10, 16), (300, 10)], [0, 1, 20, 50])

    distances = measure_distinctiveness(features["descriptors"], features["pixels"])

    assert distances.tolist() == [20, 19, 19, 30]
    assert measure_distinctiveness(np.zeros((1, 32), np.uint8), np.zeros((1, 2)), 0.0).tolist() == [256]
    assert measure_distinctiveness(np.zeros((0, 32), np.uint8), np.zeros((0, 2))).tolist() == []
    nowhere = np.array([[np.nan, np.nan], [0.0, 0.0], [np.nan, 90.0]])
    assert measure_distinctiveness(np.zeros((3, 32), np.uint8), nowhere).tolist() == [256, 0, 0]
    for wrong in (np.zeros(3, np.uint8), np.zeros((2, 32), np.uint8), np.zeros((3, 32))):
        with pytest.raises(BadRequest, match="3 features"):
            measure_distinctiveness(wrong, np.zeros((3, 2)))


# --- poses -------------------------------------------------------------------------------------


def observations(
    seed: int, *, n: int = 120, has_depth: bool = True, outliers: float = 0.0, line: bool = False
) -> tuple[Observations, Array, Array]:
    """Return what a camera measures with the noise it states, the true pose, and one about 2 cm off."""
    rng = np.random.default_rng(seed)
    truth = exp_se3(rng.normal(size=6) * 0.4)
    pixels = rng.uniform((20, 20), (620, 460), (n, 2))
    seen = CAMERA.back_project(pixels, rng.uniform(0.8, 5.0, n))
    if line:
        along = np.clip(rng.normal(size=3), -1.0, 1.0)
        seen = np.array([0.1, 0.2, 3.0]) + np.outer(rng.uniform(-1, 1, n), along)
    points = transform(inverse(truth), seen)
    factors = rng.normal(size=(n, 3, 3)) * 0.004
    covariances = factors @ factors.transpose(0, 2, 1) + 1e-8 * np.eye(3)
    known = points + np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(n, 3)))
    pixel_sigmas_px = rng.choice([0.7, 1.0, 1.44], n)
    depth_sigmas_m = 0.003 + 0.0019 * (seen[:, 2] - 0.4) ** 2
    measured = CAMERA.project(seen) + pixel_sigmas_px[:, None] * rng.normal(size=(n, 2))
    depths_m = seen[:, 2] + depth_sigmas_m * rng.normal(size=n)
    depths_m[rng.random(n) < (0.3 if has_depth else 2.0)] = 0.0
    if line:  # without noise: nothing but the free motion keeps the pose from being fitted
        measured, depths_m = CAMERA.project(seen), np.where(depths_m > 0.0, seen[:, 2], 0.0)
    wrong = rng.random(n) < outliers
    measured[wrong] += rng.normal(size=(wrong.sum(), 2)) * 80.0
    observed = Observations(
        points=points if line else known,
        covariances=covariances,
        pixels=measured,
        pixel_sigmas_px=pixel_sigmas_px,
        depths_m=depths_m,
        depth_sigmas_m=np.where(depths_m > 0.0, depth_sigmas_m, np.nan),
    )
    return observed, truth, exp_se3(rng.normal(size=6) * 0.01) @ truth


@pytest.mark.parametrize("has_depth", [True, False])
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_poses_are_those_of_the_definition(has_depth: bool, outliers: float) -> None:
    for seed in range(40):
        n = (4, 7, 30, 300)[seed % 4]
        observed, _, start = observations(seed, n=n, has_depth=has_depth, outliers=outliers)

        found = fit_pose(observed, CAMERA, start)
        expected = pose_fit.fit_pose(observed, CAMERA, start)

        assert (found is None) == (expected is None)
        if found is None or expected is None:
            assert n < 30
            continue
        np.testing.assert_allclose(found.T_camera_world, expected.T_camera_world, rtol=0, atol=1e-9)
        assert found.is_inlier.tolist() == expected.is_inlier.tolist()
        scale = np.abs(expected.information).max()
        np.testing.assert_allclose(found.information, expected.information, rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("has_depth", [True, False])
def test_the_change_of_the_readout_time_is_that_of_the_definition(has_depth: bool) -> None:
    observed, T, _ = observations(5, n=80, has_depth=has_depth)
    displacements = np.random.default_rng(5).normal(0.0, 1.0, (80, 3))

    more, information = fit_readout_change(observed, displacements, CAMERA, T)

    expected = pose_fit.fit_readout_change(observed, displacements, CAMERA, T)
    assert information > 0.0
    assert (more, information) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("has_depth", [True, False])
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_poses_are_right_within_the_simulated_noise(has_depth: bool, outliers: float) -> None:
    distances2, inliers, problems = [], 0, 60
    for seed in range(problems):
        observed, truth, start = observations(seed, has_depth=has_depth, outliers=outliers)

        fitted = fit_pose(observed, CAMERA, start)

        assert isinstance(fitted, FittedPose)
        apart = log_se3((truth @ inverse(fitted.T_camera_world))[None])[0]
        distances2.append(apart @ fitted.information @ apart)
        inliers += int(fitted.is_inlier.sum())
    # Six numbers: a mean of 6, of 60 problems +- 0.45; the gate and the Cauchy weights lose information.
    assert 4.5 < np.mean(distances2) < 9.0
    assert max(distances2) < 38.0  # 1e-6 of chi-square of six numbers
    assert inliers / (problems * 120) == pytest.approx(0.99 * (1.0 - outliers), abs=0.03)


@pytest.mark.parametrize("has_depth", [True, False])
def test_a_motion_that_nothing_holds_is_reported(has_depth: bool) -> None:
    for seed in range(20):
        for n in (0, 1, 2):
            observed, _, start = observations(seed, n=n, has_depth=has_depth)
            assert fit_pose(observed, CAMERA, start) is None
        for n in (3, 40, 1000):
            observed, truth, start = observations(seed, n=n, has_depth=has_depth, line=True)
            assert fit_pose(observed, CAMERA, start) is None
            assert fit_pose(observed, CAMERA, truth) is None


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *((name, number) for name in ("points", "pixels") for number in (NAN, INF, -INF, 2e9, -1e300)),
        *(("covariances", number) for number in (NAN, INF, -INF, 2e9, -1.0)),
        *(("pixel_sigmas_px", number) for number in (NAN, INF, 0.0, -1.0, 1e7)),
        *(("depths_m", number) for number in (NAN, INF, -INF, -1e-9, 1000.1)),
        *(("depth_sigmas_m", number) for number in (NAN, INF, 0.0, -1.0, 1e4)),
    ],
)
def test_numbers_that_no_camera_measures_give_no_pose(name: str, number: float) -> None:
    observed, _, start = observations(2)
    row = int(np.flatnonzero(observed.depths_m > 0.0)[-1])
    array = getattr(observed, name).copy()
    array[row, ...] = number

    assert fit_pose(observed, CAMERA, start) is not None
    assert fit_pose(replace(observed, **{name: array}), CAMERA, start) is None


@pytest.mark.parametrize("number", [NAN, INF, 2e9])
def test_an_initial_pose_or_a_limit_that_is_not_finite_gives_no_pose(number: float) -> None:
    observed, _, start = observations(2)
    T = start.copy()
    T[1, 3] = number

    assert fit_pose(observed, CAMERA, T) is None
    assert fit_pose(observed, CAMERA, start, gate2=number) is None
    assert fit_pose(observed, CAMERA, start, cauchy=number) is None


@pytest.mark.parametrize(
    "change",
    [
        {"points": np.zeros((119, 3))}, {"points": np.zeros((120, 2))}, {"covariances": np.zeros((120, 6))},
        {"covariances": np.zeros((1, 3, 3))}, {"pixels": np.zeros((120, 3))}, {"pixel_sigmas_px": np.ones(1)},
        {"depths_m": np.zeros((120, 1))}, {"depth_sigmas_m": np.zeros(0)},
    ],
)  # fmt: skip
def test_observations_that_do_not_fit_are_refused(change: dict[str, Array]) -> None:
    observed, _, start = observations(3)

    with pytest.raises(BadRequest, match="observations"):
        fit_pose(replace(observed, **change), CAMERA, start)
    for T in (np.eye(3), np.zeros(16), np.eye(5)):
        with pytest.raises(BadRequest, match="observations"):
            fit_pose(observed, CAMERA, T)


def test_covariances_that_are_none_never_make_an_inlier_or_an_infinite_pose() -> None:
    for seed in range(60):
        rng = np.random.default_rng(seed)
        observed, _, start = observations(seed, n=30)
        covariances = observed.covariances.copy()
        spoilt = rng.random(30) < 0.4
        covariances[spoilt, 0, 1] = covariances[spoilt, 1, 0] = 10.0 ** rng.uniform(-3, 8)

        fitted = fit_pose(replace(observed, covariances=covariances), CAMERA, start)

        if fitted is not None:
            assert np.isfinite(fitted.T_camera_world).all()
            assert np.isfinite(fitted.information).all()


def test_a_squared_distance_below_zero_is_no_small_one() -> None:
    observed, truth, _ = observations(5, has_depth=False)
    covariances, pixels = observed.covariances.copy(), CAMERA.project(transform(truth, observed.points))
    # In the camera's frame no covariance: x + y varies, x - y by less than nothing; and the pixel is off so.
    covariances[7] = truth[:3, :3].T @ np.array([[0, 1e-2, 0], [1e-2, 0, 0], [0, 0, 0]]) @ truth[:3, :3]
    covariances[7, (0, 1, 2), (0, 1, 2)] = np.maximum(covariances[7, (0, 1, 2), (0, 1, 2)], 0.0)
    pixels[7] += (200.0, -200.0)

    fitted = fit_pose(replace(observed, covariances=covariances, pixels=pixels), CAMERA, truth)

    assert fitted is not None
    assert np.flatnonzero(~fitted.is_inlier).tolist() == [7]


def test_float32_and_gaps_in_memory_give_the_same_pose() -> None:
    observed, _, start = observations(4)
    rounded = replace(
        observed,
        **{
            name: getattr(observed, name).astype(np.float32).astype(np.float64)
            for name in ("points", "pixels", "pixel_sigmas_px", "depths_m", "depth_sigmas_m")
        },
    )
    other = replace(
        rounded, points=np.asfortranarray(rounded.points.astype(np.float32)),
        pixels=np.repeat(rounded.pixels, 2, axis=0)[::2], depths_m=rounded.depths_m.astype(np.float32),
    )  # fmt: skip

    found, expected = (fit_pose(each, CAMERA, np.asfortranarray(start)) for each in (other, rounded))

    assert found is not None
    assert expected is not None
    assert found.T_camera_world.tobytes() == expected.T_camera_world.tobytes()


def test_threads_do_not_share_memory() -> None:
    requests = [request_of(seed) for seed in range(100, 108)]
    expected = [matching.match_predictions(*request) for request in requests]
    wrong: list[int] = []

    def check(which: int) -> None:
        for _ in range(100):
            found = match_predictions(*requests[which])
            if any(a.tolist() != b.tolist() for a, b in zip(found, expected[which], strict=True)):
                wrong.append(which)

    threads = [threading.Thread(target=check, args=(which,)) for which in range(len(requests))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert not wrong
