"""Seeded problems with known answers for the map services, shared by tests.

The same arguments give the same problem; every noise is an argument.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.services.mapping.wifi import AccessPointReading
from rse_pf.slam.pose_graph import PoseGraph

__all__ = ["Building", "SyntheticWorld", "make_building", "make_room", "make_sphere", "make_world"]

_NOISE_PX = 0.5
_DEPTH_NOISE = 0.005
"""Of the depth, as a share of it."""
_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def make_sphere(
    seed: int, *, rings: int = 50, per_ring: int = 50, noise_m: float = 0.02, noise_rad: float = 0.01
) -> tuple[PoseGraph, Array]:
    """Return a pose graph on a sphere of 10 m, with drift, and its ``(n, 4, 4)`` true poses.

    A camera spirals from pole to pole and looks inwards; it measures the relative pose to the next one and to
    the one a turn later.  Source: the sphere of Kuemmerle et al., g2o, ICRA 2011.
    """
    rng = np.random.default_rng(seed)
    n = rings * per_ring
    truth = np.array([_on_sphere(row, n, per_ring) for row in range(n)])
    a = np.concatenate([np.arange(n - 1), np.arange(n - per_ring)])
    b = np.concatenate([np.arange(1, n), np.arange(per_ring, n)])
    spread = np.array([noise_m] * 3 + [noise_rad] * 3)
    steps = np.array(
        [
            inverse(truth[i]) @ truth[j] @ exp_se3(rng.normal(size=6) * spread)
            for i, j in zip(a, b, strict=True)
        ]
    )
    drifted = [truth[0]]
    for step in steps[: n - 1]:
        drifted.append(drifted[-1] @ step)
    graph = PoseGraph(
        T_world_pose=np.array(drifted), a=a, b=b, T_a_b=steps,
        information=np.tile(np.diag(spread**-2.0), (len(a), 1, 1)),
        robust=np.abs(a - b) != 1, ids=np.arange(n),
    )  # fmt: skip
    return graph, truth


def make_room(seed: int, *, points: int = 20_000, noise_m: float = 0.005, walls: int = 3) -> Array:
    """Return ``(walls * points, 3)`` readings of a floor and up to two walls that meet in a corner."""
    rng = np.random.default_rng(seed)
    spans = [((4.0, 0, 0), (0, 4.0, 0)), ((4.0, 0, 0), (0, 0, 2.5)), ((0, 4.0, 0), (0, 0, 2.5))]
    parts = []
    for u, v in spans[:walls]:
        share = rng.random((points, 2))
        parts.append(share[:, :1] * np.array(u) + share[:, 1:] * np.array(v))
    cloud: Array = np.concatenate(parts)
    return cloud + rng.normal(size=cloud.shape) * noise_m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Building:
    """A simulated floor of 40 m x 20 m with rooms, access points, and radio noise as stated.

    Strength = power - 10 exponent log10(distance) - 4 dB for each wall between - shadowing - noise;
    shadowing is fixed in space (correlated over ``shadow_length_m``), noise is new for each scan.
    Readings below ``min_dbm`` are not received.
    """

    access_points: Array
    phases: Array
    waves: Array
    shadow_db: float
    noise_db: float
    exponent: float = 2.7
    power_dbm: float = -38.0
    wall_db: float = 4.0
    min_dbm: float = -90.0

    def scan(self, place: Array, rng: np.random.Generator) -> list[AccessPointReading]:
        """Return one scan of a radio at *place* ``(3,)``, metres."""
        readings = []
        for number, source in enumerate(self.access_points):
            distance = math.sqrt(float(((place - source) ** 2).sum()) + 1.0)
            dbm = self.power_dbm - 10.0 * self.exponent * math.log10(distance)
            dbm -= self.wall_db * _walls(place, source)
            wave = np.cos(self.waves[number] @ place[:2] + self.phases[number])
            dbm += self.shadow_db * math.sqrt(2.0 / len(wave)) * float(wave.sum())
            dbm += float(rng.normal()) * self.noise_db
            if dbm > self.min_dbm:
                mac = f"00:16:3e:00:00:{number:02x}"
                readings.append(AccessPointReading(mac=mac, ssid="hall", rssi_dbm=min(dbm, 0.0)))
        return readings


def make_building(
    seed: int,
    *,
    access_points: int = 12,
    shadow_db: float = 3.0,
    noise_db: float = 3.0,
    shadow_length_m: float = 5.0,
) -> Building:
    """Return a building whose access points and shadows follow from *seed*."""
    rng = np.random.default_rng(seed)
    places = np.column_stack(
        [
            rng.uniform(0, 40, access_points),
            rng.uniform(0, 20, access_points),
            np.full(access_points, 2.5),
        ]
    )
    waves = rng.normal(size=(access_points, 24, 2)) / shadow_length_m
    phases = rng.uniform(0, 2 * math.pi, (access_points, 24))
    return Building(
        access_points=places, phases=phases, waves=waves, shadow_db=shadow_db, noise_db=noise_db
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyntheticWorld:
    """Points with descriptors on the walls of a square hall, and the maps of robots in it."""

    points: Array
    descriptors: npt.NDArray[np.uint8]

    def pose(self, turn: float) -> Array:
        """Return ``T_world_camera`` after *turn* rounds: on a circle of 1.5 m, looking outwards."""
        angle = 2.0 * math.pi * turn
        forward = np.array([math.cos(angle), math.sin(angle), 0.0])
        right, down = np.array([math.sin(angle), -math.cos(angle), 0.0]), np.array([0.0, 0.0, -1.0])
        T = np.eye(4)
        T[:3, :3] = np.column_stack([right, down, forward])
        T[:3, 3] = 1.5 * forward + np.array([0.0, 0.0, 1.2])
        return T

    def keyframe(
        self, number: int, robot: str, T_true: Array, T_world_camera: Array, rng: np.random.Generator
    ) -> Keyframe:
        """Return the keyframe of a camera at *T_true*, with the estimated pose *T_world_camera*."""
        seen = transform(inverse(T_true), self.points)
        ahead = np.flatnonzero(seen[:, 2] > 0.3)
        pixels = _CAMERA.project(seen[ahead])
        inside = ((pixels >= 0) & (pixels < [_CAMERA.width, _CAMERA.height])).all(axis=1)
        rows, pixels = ahead[inside], pixels[inside]
        pixels = pixels + rng.normal(size=pixels.shape) * _NOISE_PX
        depth = seen[rows, 2] * (1.0 + rng.normal(size=len(rows)) * _DEPTH_NOISE)
        flipped = np.packbits(rng.random((len(rows), 256)) < 0.05, axis=1)
        return Keyframe(
            id=number, robot=robot, timestamp_s=float(number), T_world_camera=T_world_camera, camera=_CAMERA,
            pixels=pixels.astype(np.float32), descriptors=self.descriptors[rows] ^ flipped,
            points_camera=_CAMERA.back_project(pixels, depth).astype(np.float32),
        )  # fmt: skip

    def walk(
        self, robot: str, turns: Array, seed: int, *, drift_m: float = 0.01, drift_deg: float = 0.3
    ) -> tuple[MapVersion, Array]:
        """Return a robot's map, in its own drifting world frame, and its ``(n, 4, 4)`` true poses."""
        rng = np.random.default_rng(seed)
        truth = np.array([self.pose(turn) for turn in turns])
        spread = np.array([drift_m] * 3 + [math.radians(drift_deg)] * 3)
        drifted = [np.eye(4)]
        for one, other in pairwise(truth):
            drifted.append(drifted[-1] @ inverse(one) @ other @ exp_se3(rng.normal(size=6) * spread))
        keyframes = tuple(
            self.keyframe(number, robot, true, pose, rng)
            for number, (true, pose) in enumerate(zip(truth, drifted, strict=True))
        )
        return MapVersion(keyframes=keyframes, provenance={"robot": robot}), truth


def make_world(seed: int, *, points: int = 3000) -> SyntheticWorld:
    """Return a hall of 8 m x 8 m x 2.5 m whose walls carry *points* with random descriptors."""
    rng = np.random.default_rng(seed)
    along, height = rng.uniform(-4, 4, points), rng.uniform(0, 2.5, points)
    depth = 4.0 - np.abs(rng.normal(size=points)) * 0.3
    wall = rng.integers(0, 4, points)
    x = np.select([wall == 0, wall == 1, wall == 2], [depth, -depth, along], along)
    y = np.select([wall == 0, wall == 1, wall == 2], [along, along, depth], -depth)
    descriptors = rng.integers(0, 256, (points, 32), dtype=np.uint8)
    return SyntheticWorld(points=np.column_stack([x, y, height]), descriptors=descriptors)


def _walls(place: Array, source: Array) -> int:
    """Return how many walls lie between: rooms of 8 m by 10 m."""
    across = abs(math.floor(place[0] / 8.0) - math.floor(source[0] / 8.0))
    return int(across + abs(math.floor(place[1] / 10.0) - math.floor(source[1] / 10.0)))


def _on_sphere(row: int, n: int, per_ring: int) -> Array:
    down, round_ = math.pi * (0.05 + 0.9 * row / n), 2.0 * math.pi * row / per_ring
    outward = np.array([math.sin(down) * math.cos(round_), math.sin(down) * math.sin(round_), math.cos(down)])
    x = np.array([-math.sin(round_), math.cos(round_), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(-outward, x), -outward])
    T[:3, 3] = 10.0 * outward
    return T
