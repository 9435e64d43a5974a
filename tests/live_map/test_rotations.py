"""One rule for what a rotation is: a pose that was accepted is never refused later."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from rse_pf.errors import BadRequest, InternalError
from rse_pf.geometry import Array, exp_se3, inverse
from rse_pf.live_map.events import KeyframeAdded, LoopClosuresMeasured
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.versions import started_from
from rse_pf.maps.format import decode_map, encode_map
from rse_pf.server.live_map.router import _check_keyframe, _decode_request
from rse_pf.slam.keyframe import encode_keyframe
from rse_pf.slam.optimise import OptimiseOptions
from rse_pf.slam.pose_graph import PoseGraph
from rse_pf.wire.live_map import KeyframeRequest
from tests.kit.generated_drives import INFORMATION, GeneratedWorld, make_link, straight

FITTING = np.sqrt(1.0 + 1.9e-3)
"""A rotation that is scaled by this is accepted, and the step between two of them was refused."""


def sent(T: Array, good: KeyframeAdded, number: int) -> KeyframeAdded:
    """Return the event of a keyframe that a raw client sent with the pose *T*."""
    keyframe = encode_keyframe(dataclasses.replace(good.keyframe, timestamp_s=1.0, T_odom_camera=T))
    payload = {"map": "m", "segment": 0, "number": number, "keyframe": keyframe}
    request = _decode_request("live-keyframe", payload)
    _check_keyframe(request)
    assert isinstance(request, KeyframeRequest)
    return KeyframeAdded(robot="default/raw", segment=0, number=number, data=request.keyframe)


def with_pose(event: KeyframeAdded, T: Array) -> KeyframeAdded:
    """Return *event* with the pose *T*, as it is."""
    data = encode_keyframe(dataclasses.replace(event.keyframe, T_odom_camera=T))
    return msgspec.structs.replace(event, data=data)


def rounded(rng: np.random.Generator, decimals: int) -> Array:
    T = exp_se3(np.r_[rng.uniform(-50, 50, 3), rng.normal(0, 2, 3)])
    if decimals == 0:
        T[:3, :3] *= rng.uniform(1 / FITTING, FITTING)
        return T
    return T.round(decimals)


def as_first_graph(graph: PoseGraph, options: OptimiseOptions) -> Array:
    return graph.T_world_pose


@pytest.mark.parametrize("decimals", [3, 4, 5, 7, 0], ids=["3", "4", "5", "7", "scaled"])
def test_a_rounded_pose_that_is_accepted_is_published_optimised_and_started_from(decimals: int) -> None:
    world, rng = GeneratedWorld(seed=1), np.random.default_rng(decimals)
    good = world.keyframe(world.drive("a", straight(0.0, 0.2)), 0)
    live_map, poses = LiveMap(), [rounded(rng, decimals) for _ in range(500)]

    for number, T in enumerate(poses):
        event = sent(T, good, number)
        assert live_map.check_keyframe(event) == "new"
        live_map.apply(event)
    T_exact = np.array([live_map.pose(i) for i in range(500)])
    for k in range(20, 500, 20):
        step = inverse(T_exact[k]) @ T_exact[k - 5]
        live_map.apply(LoopClosuresMeasured(keyframe=k, links=(make_link(k - 5, step),)))
    version = live_map.to_version()
    data = encode_map(version)
    again = decode_map(data)
    live_map.apply(live_map.prepare_optimisation(as_first_graph)())

    assert encode_map(again) == data
    assert len(version.keyframes) == 500
    T = np.array([each.T_world_camera for each in version.keyframes])
    gram = np.swapaxes(T[:, :3, :3], 1, 2) @ T[:, :3, :3]
    assert np.abs(gram - np.eye(3)).max() < 1e-9
    LiveMap().apply(started_from(again, "m@1"))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e7, -1e300])
@pytest.mark.parametrize("place", [(0, 0), (0, 3), (2, 3)])
def test_absurd_poses_are_refused_where_they_arrive(wrong: float, place: tuple[int, int]) -> None:
    world = GeneratedWorld(seed=1)
    good = world.keyframe(world.drive("a", straight(0.0, 0.2)), 0)
    T = np.eye(4)
    T[place] = wrong

    with pytest.raises(BadRequest, match=r"T_odom_camera|not finite"):
        sent(T, good, 0)
    with pytest.raises(BadRequest, match="T_odom_camera"):
        LiveMap().check_keyframe(with_pose(good, T))


def test_a_log_of_an_earlier_release_with_scaled_rotations_is_replayed_and_published() -> None:
    world = GeneratedWorld(seed=1)
    drive = world.drive("a", straight(0.0, 1.2))
    one, other = LiveMap(), LiveMap()
    for number in range(12):
        event = world.keyframe(drive, number)
        T = event.keyframe.T_odom_camera.copy()
        T[:3, :3] *= 1.0 + 4.9e-5 * (-1) ** number
        stored = with_pose(event, T)
        for live_map in (one, other):
            live_map.apply(stored)

    assert one.digest() == other.digest()
    assert len(decode_map(encode_map(one.to_version())).keyframes) == 12


def test_a_map_that_cannot_be_published_is_no_bad_request_of_its_client() -> None:
    world = GeneratedWorld(seed=1)
    drive = world.drive("a", straight(0.0, 1.2))
    live_map = LiveMap()
    for number in range(3):
        live_map.apply(world.keyframe(drive, number))
    live_map._graph.T_component_camera[1, 0, 3] = np.nan

    with pytest.raises(InternalError, match="the live map cannot be published: keyframe 1"):
        live_map.to_version()


@pytest.mark.parametrize("wrong", [np.zeros((6, 6)), -INFORMATION, np.full((6, 6), 1e17)])
def test_a_version_with_absurd_information_begins_no_map(wrong: Array) -> None:
    world = GeneratedWorld(seed=1)
    drive = world.drive("a", straight(0.0, 1.2))
    live_map = LiveMap()
    for number in range(3):
        live_map.apply(world.keyframe(drive, number))
    version = live_map.to_version()
    first = dataclasses.replace(version.edges[0], information=wrong)

    with pytest.raises(InternalError, match="information"):
        started_from(dataclasses.replace(version, edges=(first, *version.edges[1:])), "m@1")
