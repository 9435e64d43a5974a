"""Localisation of one view among keyframes with known poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import exp_se3, inverse, pose_difference
from rse_pf.live_map.measure import landmarks_of_features, view_of_features
from rse_pf.slam.keyframe import KeyframeFeatures, make_features
from rse_pf.slam.localise import (
    LocalisationCandidate,
    LocalisationOptions,
    Localised,
    PosePrior,
    localise,
    spread_candidates,
)
from rse_pf.slam.relative_pose import RelativePoseOptions
from tests.kit.synthetic_maps import make_world


def coded(keyframe) -> KeyframeFeatures:
    return make_features(keyframe.pixels, keyframe.points_camera[:, 2], keyframe.descriptors)


def candidates_of(seed: int, turns, T_map_world=None):
    """Return id, features, camera and true pose of each keyframe of a drive around a hall."""
    T_map_world = np.eye(4) if T_map_world is None else T_map_world
    version, truth = make_world(seed, points=4000).walk("r", np.asarray(turns), seed=5)
    return [
        (number, coded(keyframe), keyframe.camera, T_map_world @ truth[number])
        for number, keyframe in enumerate(version.keyframes)
    ]


TURNS = (0.0, 0.02, 0.05, 0.3, 0.6)
MAP = candidates_of(3, TURNS)
_, VIEW, CAMERA, T_VIEW = candidates_of(3, (0.0, 0.035))[1]
ELSEWHERE = exp_se3([12.0, 1.0, 0.0, 0.0, 0.0, 1.0])
TURNED = T_VIEW @ exp_se3([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]) @ inverse(T_VIEW)
"""A rotation of the map by 1 rad about the camera of `VIEW`."""


def place_of(
    candidates, view: KeyframeFeatures, camera, *options: LocalisationOptions, prior: PosePrior | None = None
) -> Localised:
    """Localise *view* among candidates, given as id, features, camera and pose."""
    placed = [
        LocalisationCandidate(id=number, landmarks=landmarks_of_features(features, of), T_map_keyframe=T)
        for number, features, of, T in candidates
    ]
    return localise(placed, view_of_features(view, camera), *options, prior=prior)


def prior_at(T_map_camera) -> PosePrior:
    """Return a prior of RViz: 0.5 m and 15 degrees in the plane, without a deviation of the height."""
    return PosePrior(T_map_camera=T_map_camera, covariance=np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.068]))


def renumbered(candidates, first: int):
    return [(first + number, *rest) for number, *rest in candidates]


def test_a_view_finds_its_place():
    found = place_of(MAP, VIEW, CAMERA)

    assert (found.verdict, found.reason) == ("ok", "")
    metres, degrees = pose_difference(found.T_map_camera, T_VIEW)
    assert metres < 0.01
    assert degrees < 0.2
    assert set(found.keyframes) == {0, 1, 2}
    assert found.inliers <= found.matches


def test_the_covariance_is_that_of_the_twist_on_the_left():
    far = exp_se3([100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    here = place_of(MAP, VIEW, CAMERA).covariance
    there = place_of([(n, f, c, far @ T) for n, f, c, T in MAP], VIEW, CAMERA).covariance

    deviations = np.sqrt(np.diag(there))
    assert np.allclose(there, there.T)
    assert np.linalg.eigvalsh(here).min() > 0
    # 0.7 degrees at least, and 100 m from the origin as its lever.
    assert deviations[1] > 100.0 * np.radians(0.7)
    assert 0.02 < deviations[0] < 1.0


def test_a_foreign_view_has_no_place():
    _, foreign, camera, _ = candidates_of(4, (0.0,))[0]

    found = place_of(MAP, foreign, camera)

    assert (found.verdict, found.reason, found.T_map_camera) == ("none", "no-pose", None)


@pytest.mark.parametrize("other", [ELSEWHERE, TURNED], ids=["elsewhere", "turned"])
def test_two_places_that_look_alike_are_ambiguous(other):
    twice = MAP + renumbered([(n, f, c, other @ T) for n, f, c, T in MAP], 10)

    found = place_of(twice, VIEW, CAMERA)

    assert (found.verdict, found.reason) == ("weak", "ambiguous")
    assert found.T_map_camera is not None


@pytest.mark.parametrize("other", [ELSEWHERE, TURNED], ids=["elsewhere", "turned"])
@pytest.mark.parametrize("is_other", [False, True], ids=["here", "there"])
def test_a_prior_decides_between_two_places_that_look_alike(other, is_other):
    twice = MAP + renumbered([(n, f, c, other @ T) for n, f, c, T in MAP], 10)
    true = other @ T_VIEW if is_other else T_VIEW

    found = place_of(twice, VIEW, CAMERA, prior=prior_at(true @ exp_se3([0.4, 0.1, 0.3, 0.05, 0.1, 0.05])))

    assert (found.verdict, found.reason) == ("ok", "")
    metres, degrees = pose_difference(found.T_map_camera, true)
    assert metres < 0.01
    assert degrees < 0.2


def test_a_place_outside_of_a_wrong_prior_needs_the_evidence_that_it_needs_without_one():
    wrong = prior_at(exp_se3([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T_VIEW)

    assert place_of(MAP, VIEW, CAMERA, prior=wrong).verdict == "ok"
    alone = LocalisationOptions(min_single_inliers=1000)
    assert place_of(MAP[1:2], VIEW, CAMERA, alone, prior=wrong).reason == "one-keyframe"


@pytest.mark.parametrize("reason", ["one-keyframe", "few-inliers"])
def test_a_place_within_the_prior_needs_less_evidence(reason):
    inliers = place_of(MAP, VIEW, CAMERA).inliers
    options = LocalisationOptions(min_single_inliers=1000)
    if reason == "few-inliers":
        strict = replace(options.relative_pose, min_inliers=int(1.5 * inliers))
        options = replace(options, relative_pose=strict)
    used = MAP[1:2] if reason == "one-keyframe" else MAP

    assert place_of(used, VIEW, CAMERA, options).reason == reason
    assert place_of(used, VIEW, CAMERA, options, prior=prior_at(T_VIEW)).verdict == "ok"


@pytest.mark.parametrize(
    ("T", "covariance"),
    [
        (np.diag([2.0, 1.0, 1.0, 1.0]), np.eye(6)),
        (np.eye(4), -np.eye(6)),
        (np.eye(4), np.full((6, 6), np.nan)),
        (np.eye(4), 1e13 * np.eye(6)),
    ],
)
def test_a_prior_that_is_none_is_refused(T, covariance):
    with pytest.raises(BadRequest, match="prior"):
        PosePrior(T_map_camera=T, covariance=covariance)


def test_a_place_that_looks_alike_only_in_part_does_not_make_it_ambiguous():
    keyframe = MAP[1][1]
    part = KeyframeFeatures(
        pixels=keyframe.pixels[:16], depths_m=keyframe.depths_m[:16], descriptors=keyframe.descriptors[:16]
    )

    found = place_of([*MAP, (10, part, CAMERA, ELSEWHERE @ MAP[1][3])], VIEW, CAMERA)

    assert (found.verdict, found.reason) == ("ok", "")
    assert 10 not in found.keyframes


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"min_single_inliers": 1000}, "one-keyframe"),
        ({"min_single_inliers": 10}, ""),
    ],
)
def test_one_keyframe_alone_needs_more_inliers(options, reason):
    found = place_of(MAP[1:2], VIEW, CAMERA, LocalisationOptions(**options))

    assert found.reason == reason
    assert found.verdict == ("weak" if reason else "ok")


def test_few_inliers_are_weak():
    options = LocalisationOptions()
    strict = replace(options, relative_pose=replace(options.relative_pose, min_inliers=200))

    found = place_of(MAP[:1], VIEW, CAMERA, strict)

    assert found.inliers < 200
    assert (found.verdict, found.reason) == ("weak", "few-inliers")


def test_a_view_far_from_its_keyframes_by_metres_is_still_relative_to_them():
    moved = [(n, f, c, ELSEWHERE @ T) for n, f, c, T in MAP]

    found = place_of(moved, VIEW, CAMERA)

    metres, _ = pose_difference(inverse(ELSEWHERE) @ found.T_map_camera, T_VIEW)
    assert metres < 0.01


def test_candidates_that_look_another_way_are_of_another_place():
    poses = np.array([exp_se3([0.0, 0.0, 0.0, 0.0, np.radians(90.0) * (n // 4), 0.0]) for n in range(8)])

    found = [(number, 0.5) for number in range(8)]

    assert spread_candidates(found, poses, 6, LocalisationOptions(max_per_region=2)) == [0, 1, 4, 5]


def strip(number: int, left: float, right: float) -> LocalisationCandidate:
    """Return a candidate of `MAP` with only the features between two columns of its image."""
    _, features, camera, T_map_keyframe = MAP[number]
    rows = np.flatnonzero((features.pixels[:, 0] >= left) & (features.pixels[:, 0] < right))
    part = KeyframeFeatures(
        pixels=features.pixels[rows], depths_m=features.depths_m[rows], descriptors=features.descriptors[rows]
    )
    return LocalisationCandidate(
        id=number, landmarks=landmarks_of_features(part, camera), T_map_keyframe=T_map_keyframe
    )


def test_keyframes_that_are_weak_alone_place_a_view_without_depths_together():
    view = replace(view_of_features(VIEW, CAMERA), depths_m=None)
    options = LocalisationOptions(min_single_inliers=10, relative_pose=RelativePoseOptions(min_inliers=12))
    strips = [strip(1, 60.0, 100.0), strip(2, 360.0, 400.0)]

    alone, together = localise(strips[:1], view, options), localise(strips, view, options)

    assert (alone.verdict, alone.reason) == ("weak", "nearly-collinear")
    assert (together.verdict, together.reason) == ("ok", "")
    assert set(together.keyframes) == {1, 2}
