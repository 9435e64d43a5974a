"""A robot is relocalised in a live map, also where two places look alike, by where it is expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.geometry import exp_se3, pose_difference
from rse_pf.live_map.events import MapStarted, StartKeyframe
from rse_pf.live_map.live_map import LiveMap
from rse_pf.maps.format import Keyframe
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe
from rse_pf.slam.localise import PosePrior
from tests.kit.synthetic_maps import make_world

ELSEWHERE = exp_se3(np.array([12.0, 1.0, 0.0, 0.0, 0.0, 1.0]))


def start(keyframe: Keyframe) -> StartKeyframe:
    return StartKeyframe(robot="r", data=encode_keyframe(SentKeyframe.from_map(keyframe)))


@pytest.mark.parametrize("is_elsewhere", [False, True])
def test_a_prior_decides_between_equal_places_also_if_one_has_many_more_keyframes(is_elsewhere: bool) -> None:
    world = make_world(3, points=4000)
    turns = np.r_[0.0:0.2:20j]
    version, truth = world.walk("r", turns, seed=5)
    here = [replace(each, T_world_camera=T) for each, T in zip(version.keyframes, truth, strict=True)]
    there = [replace(each, T_world_camera=ELSEWHERE @ each.T_world_camera) for each in here[8:12]]
    live_map = LiveMap()
    live_map.apply(MapStarted(source="hall@1", keyframes=tuple(map(start, [*here, *there]))))
    seen, poses = world.walk("r", np.array([0.0, 0.1]), seed=5)
    view = SentKeyframe.from_map(seen.keyframes[1])
    true = (ELSEWHERE if is_elsewhere else np.eye(4)) @ poses[1]
    prior = PosePrior(
        T_map_camera=true @ exp_se3(np.array([0.3, 0.0, 0.2, 0.0, 0.1, 0.0])), covariance=0.1 * np.eye(6)
    )

    assert live_map.relocalise(view).reason == "ambiguous"
    found = live_map.prepare_relocalisation(view, prior)()

    assert found.verdict == "ok"
    metres, degrees = pose_difference(found.T_map_camera, true)
    assert metres < 0.02
    assert degrees < 0.5
