"""Relative poses of keyframes by their features."""

from __future__ import annotations

import numpy as np

from rse_pf.geometry import Array, exp_se3, inverse, pose_difference, transform
from rse_pf.live_map.events import LoopClosuresMeasured, matrix_of
from rse_pf.live_map.measure import measure_loop_closures, measure_stored_keyframes, merge_measurements
from rse_pf.maps.format import Keyframe
from rse_pf.pnp import DepthNoise
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.keyframe import KeyframeFeatures, SentKeyframe, encode_keyframe, make_features
from rse_pf.slam.relative_pose import RelativePoseOptions
from tests.kit.synthetic_maps import make_world

WORLD, TRUTH = make_world(3, points=4000).walk("r", np.array([0.0, 0.02, 0.04, 0.5]), seed=1)
CAMERA = WORLD.keyframes[0].camera


def coded(keyframe: Keyframe) -> KeyframeFeatures:
    return make_features(keyframe.pixels, keyframe.points_camera[:, 2], keyframe.descriptors)


FEATURES = [coded(each) for each in WORLD.keyframes]


def numbered(number: int):
    return number, FEATURES[number], CAMERA


def test_a_loop_closure_is_the_pose_of_the_other_keyframe_in_the_frame_of_the_new_one():
    found = measure_loop_closures(numbered(0), [numbered(1), numbered(2)])

    assert [link.other for link in found.links] == [1, 2]
    for link in found.links:
        T = matrix_of(link.T_keyframe_other, 4, 4)
        metres, degrees = pose_difference(T, inverse(TRUTH[0]) @ TRUTH[link.other])
        assert metres < 0.02
        assert degrees < 0.3
        assert 40 <= link.inliers <= link.matches


def test_the_covariance_has_a_minimum():
    options = RelativePoseOptions()
    (link,) = measure_loop_closures(numbered(0), [numbered(1)], options).links

    covariance = np.linalg.inv(matrix_of(link.information, 6, 6))

    deviations = np.sqrt(np.diag(covariance))
    assert (deviations[:3] >= 0.02).all()
    assert (deviations[:3] < 0.04).all()
    assert (deviations[3:] >= np.radians(0.7)).all()


def test_candidates_that_are_measured_in_two_pieces_give_the_same_event():
    others = [numbered(3), numbered(1), numbered(2)]
    whole = measure_loop_closures(numbered(0), others)

    pieces = [measure_loop_closures(numbered(0), others[:2]), measure_loop_closures(numbered(0), others[2:])]

    assert merge_measurements(0, pieces) == whole
    assert len(whole.links) == 2
    assert merge_measurements(0, [LoopClosuresMeasured(keyframe=0, failed={"a": 1})] * 2).failed == {"a": 2}


def test_too_few_inliers_are_no_loop_closure():
    found = measure_loop_closures(numbered(0), [numbered(1)], RelativePoseOptions(min_inliers=700))

    assert found.links == ()
    assert sum(found.failed.values()) == 1


def test_a_weakly_determined_pose_is_no_loop_closure():
    near = FEATURES[0].pixels[:, 0] < 25  # a narrow column of the image
    narrow = KeyframeFeatures(
        pixels=FEATURES[0].pixels[near], depths_m=FEATURES[0].depths_m[near],
        descriptors=FEATURES[0].descriptors[near],
    )  # fmt: skip

    found = measure_loop_closures((0, narrow, CAMERA), [numbered(1)], RelativePoseOptions(min_inliers=8))

    assert found.links == ()
    assert found.failed == {"nearly-collinear": 1}


NOISY = DepthNoise(base_m=4 * DepthNoise().base_m, growth_per_m=4 * DepthNoise().growth_per_m)


def noisy_pair(seed: int, noise: DepthNoise) -> tuple[bytes, bytes, Array]:
    """Return two encoded keyframes of one scene, whose depths are as noisy as NOISY says, and ``T_a_b``.

    *noise* is what the keyframes say.
    """
    rng = np.random.default_rng(seed)
    T_a_b = exp_se3(np.concatenate([rng.uniform(-0.2, 0.2, 3), rng.normal(size=3) * 0.08]))
    pixels, depths_m = rng.uniform([80.0, 80.0], [560.0, 400.0], (150, 2)), rng.uniform(1.5, 4.5, 150)
    descriptors = rng.integers(0, 256, (150, 32), dtype=np.uint8)
    seen = transform(inverse(T_a_b), KINECT.back_project(pixels, depths_m))

    def encoded(pixels: Array, depths_m: Array) -> bytes:
        pixels = pixels + 0.5 * rng.normal(size=pixels.shape)
        depths_m = depths_m + rng.normal(size=len(depths_m)) * np.sqrt(NOISY.variance_m2(depths_m))
        features = make_features(pixels, depths_m, descriptors, noise)
        return encode_keyframe(
            SentKeyframe(timestamp_s=0.0, T_odom_camera=np.eye(4), camera=KINECT, features=features)
        )

    return encoded(pixels, depths_m), encoded(KINECT.project(seen), seen[:, 2]), T_a_b


def test_stored_keyframes_weigh_their_depths_by_the_noise_that_they_state():
    def median_error_m(noise: DepthNoise) -> float:
        errors = []
        for seed in range(40):
            one, other, T_a_b = noisy_pair(seed, noise)
            (link,) = measure_stored_keyframes((0, one), [(1, other)]).links
            errors.append(pose_difference(matrix_of(link.T_keyframe_other, 4, 4), T_a_b)[0])
        return float(np.median(errors))

    assert median_error_m(NOISY) < 0.8 * median_error_m(DepthNoise())
