"""A published map is upright where its robots have an IMU; false gravity of one robot does not tilt it."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from rse_pf.geometry import Array
from rse_pf.live_map.events import KeyframeAdded
from rse_pf.live_map.live_map import LiveMap
from rse_pf.maps.format import MapVersion
from rse_pf.slam.inertial import KeyframeImu
from rse_pf.slam.keyframe import decode_keyframe, encode_keyframe
from tests.kit.generated_drives import GeneratedWorld, circle

DOWN = np.array([0.3, 0.9, -0.2]) / np.linalg.norm([0.3, 0.9, -0.2])
"""Direction of gravity in the true world, a unit vector."""
FALSE = np.array([1.0, 0.0, 0.0])


def published(downs: dict[str, Array]) -> tuple[MapVersion, GeneratedWorld]:
    """Return the published map of three robots, which state the directions of gravity *downs*."""
    world = GeneratedWorld(seed=3)
    drives = [
        world.drive(robot, circle(0.5, 0.7, phase=phase))
        for robot, phase in (("a", 0.0), ("b", 2.0), ("c", 4.0))
    ]
    made = LiveMap()
    for event in world.play(drives, 0.0):
        if isinstance(event, KeyframeAdded):
            robot = world.owners[-1][0]
            if robot in downs:
                seen = decode_keyframe(event.data)
                imu = KeyframeImu(
                    down_camera=world.seen[-1][:3, :3].T @ downs[robot], deviation_rad=0.005,
                    T_imu_camera=np.eye(4),
                )  # fmt: skip
                data = encode_keyframe(replace(seen, imu=imu))
                event = msgspec.structs.replace(event, data=data)
        made.apply(event)
    return made.to_version(), world


def down_of(version: MapVersion, world: GeneratedWorld) -> Array:
    """Return the mean direction of down in a published map."""
    downs = [each.T_world_camera[:3, :3] @ world.seen[each.id][:3, :3].T @ DOWN for each in version.keyframes]
    mean: Array = np.mean(downs, axis=0)
    return mean / float(np.linalg.norm(mean))


def test_z_of_a_published_map_points_up():
    version, world = published({"a": DOWN, "b": DOWN})

    assert down_of(version, world)[2] < -0.999


def test_false_gravity_of_one_of_three_robots_does_not_tilt_the_map():
    version, world = published({"a": FALSE, "b": DOWN, "c": DOWN})

    assert down_of(version, world)[2] < -0.999


def test_a_map_whose_robots_do_not_agree_keeps_its_axes():
    plain, world = published({})
    disputed, _ = published({"a": FALSE, "b": DOWN})

    np.testing.assert_allclose(down_of(disputed, world), down_of(plain, world), atol=1e-9)
