"""Drives made of exact points on the walls of a room, with features that match, and any fault.

Nothing is rendered: a drive takes milliseconds, and its truth is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from client_sdk.check.keyframes import Keyframe, KeyframeStore
from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform
from rse_pf.pnp import DepthNoise

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
ROOM_M = np.array([2.5, 1.6, 3.0])
STEP_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Made:
    """What a drive is like; the set calibration is ``CAMERA``, and the faults are what it lacks.

    ``focal`` and ``principal_px`` are added to the true camera; ``zoom_after`` is the factor of the second
    half, or of every second stretch of so many views; ``depth_noise`` is that of a Kinect times so much;
    ``turn`` and ``roll`` scale how the camera turns; ``moves_m`` is how far it moves, ``speed`` how fast.
    The room is ``size`` times the usual one, or its far wall alone; ``depth_share`` of the features have a
    depth.
    """

    seed: int = 0
    views: int = 30
    fx: float = 0.0
    cx_px: float = 0.0
    k1: float = 0.0
    offset_m: float = 0.0
    delay_s: float = 0.0
    flip: bool = False
    zoom_after: float = 1.0
    zoom_stretch: int = 0
    depth_noise: float = 1.0
    turn: float = 0.5
    roll: float = 0.3
    has_depth: bool = True
    noise_px: float = 0.4
    moves_m: tuple[float, float, float] = (0.6, 0.6, 0.6)
    speed: float = 1.0
    size: float = 1.0
    is_wall: bool = False
    points: int = 1500
    depth_share: float = 1.0


def make_store(made: Made) -> KeyframeStore:
    """Return the keyframes that an observer would keep of a drive."""
    rng = np.random.default_rng([made.seed, 33])
    points = _walls(rng, made)
    looks = rng.integers(0, 256, (len(points), 32), dtype=np.uint8)
    phases = rng.uniform(0.0, 2.0 * np.pi, 6)
    store = KeyframeStore()
    store.has_depth = made.has_depth
    store.frames = 3 * made.views
    for view in range(made.views):
        time_s = 0.3 * view
        is_second = view // (made.zoom_stretch or made.views // 2) % 2 == 1
        zoom = made.zoom_after if is_second else 1.0
        store.keyframes.append(_keyframe(made, rng, points, looks, phases, time_s, zoom))
    return store


def pose_at(made: Made, phases: Array, time_s: float) -> Array:
    """Return ``T_world_camera`` of a hand that moves and turns about the middle of the room."""
    waves = np.sin(np.array([0.9, 0.7, 0.8, 0.6, 0.75, 0.5]) * made.speed * time_s + phases)
    turned = waves[3:] * (made.turn, made.turn, made.roll)
    T: Array = exp_se3(np.concatenate([np.zeros(3), turned]))
    T[:3, 3] = np.array(made.moves_m) * waves[:3]
    return T


def _walls(rng: np.random.Generator, made: Made) -> Array:
    count, room_m = made.points, made.size * ROOM_M
    points = rng.uniform(-1.0, 1.0, (count, 3)) * room_m
    axis = rng.integers(0, 3, count)
    rows = np.arange(count)
    points[rows, axis] = np.sign(points[rows, axis]) * room_m[axis]
    if made.is_wall:
        points[:, 2] = room_m[2]
    return points


def _true_camera(made: Made, zoom: float) -> Camera:
    fx = CAMERA.fx / (1.0 + made.fx) * zoom
    return Camera(fx=fx, fy=CAMERA.fy * zoom, cx=CAMERA.cx - made.cx_px, cy=CAMERA.cy, width=640, height=480)


def _seen_at(made: Made, camera: Camera, T_world_camera: Array, pixels: Array) -> Array:
    """Return the true depths at pixels: those of the walls of the room."""
    rays = camera.back_project(pixels, np.ones(len(pixels))) @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = (np.sign(rays) * made.size * ROOM_M - T_world_camera[:3, 3]) / rays
    depths: Array = reach[:, 2] if made.is_wall else reach.min(axis=1)
    return depths


def _measured(made: Made, rng: np.random.Generator, depths: Array) -> Array:
    noise = made.depth_noise * np.sqrt(DepthNoise().variance_m2(depths))
    measured: Array = depths + made.offset_m + noise * rng.standard_normal(len(depths))
    if made.depth_share < 1.0:
        measured[rng.uniform(size=len(depths)) >= made.depth_share] = np.nan
    return measured


def _keyframe(
    made: Made,
    rng: np.random.Generator,
    points: Array,
    looks: Array,
    phases: Array,
    time_s: float,
    zoom: float,
) -> Keyframe:
    camera, T = _true_camera(made, zoom), pose_at(made, phases, time_s)
    seen = transform(inverse(T), points)
    rows = np.flatnonzero(seen[:, 2] > 0.3)
    x, y = seen[rows, 0] / seen[rows, 2], seen[rows, 1] / seen[rows, 2]
    ideal = np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)
    bent = 1.0 + made.k1 * (x * x + y * y)
    pixels = np.stack([camera.fx * x * bent + camera.cx, camera.fy * y * bent + camera.cy], axis=1)
    inside = ((pixels > 5) & (pixels < (634, 474))).all(axis=1)
    rows, pixels, ideal = rows[inside][:300], pixels[inside][:300], ideal[inside][:300]
    around = []
    for step in range(-4, 5):
        apart_s = step * STEP_S
        there = pose_at(made, phases, time_s + apart_s - made.delay_s)
        around.append((apart_s, _measured(made, rng, _seen_at(made, camera, there, ideal))))
    now = around[4][1]
    mirrored = _measured(
        made, rng, _seen_at(made, camera, T, np.stack([639.0 - ideal[:, 0], ideal[:, 1]], 1))
    )
    depths = np.stack(
        [mirrored, now, now[::-1], now[::-1]] if made.flip else [now, mirrored, now[::-1], now[::-1]]
    )
    if made.flip:
        around = [(apart_s, mirrored) for apart_s, _ in around]
    if not made.has_depth:
        depths, around = np.full_like(depths, np.nan), []
    return Keyframe(
        row=round(time_s / STEP_S), timestamp_s=time_s, camera=CAMERA,
        pixels=pixels + made.noise_px * rng.standard_normal(pixels.shape), sizes=np.ones(len(rows)),
        descriptors=looks[rows], depths_m=depths, noise=DepthNoise(), twist_s=np.zeros(6),
        T_world_camera=T, around=around,
    )  # fmt: skip


HEALTHY = Made()
__all__ = ["CAMERA", "HEALTHY", "Made", "make_store", "pose_at", "replace"]
