"""Events of robots that drive through a generated building, with loop closures made from their true poses.

No image is rendered: features are random, and a measured relative pose is the true one with noise.  So a map
of 10,000 keyframes is made in seconds, and every wrong loop closure is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import msgspec
import numpy as np

from rse_pf.geometry import Array, Camera, exp_se3, inverse, scaled
from rse_pf.live_map.events import (
    KeyframeAdded,
    LoopClosuresMeasured,
    MeasuredLoopClosure,
    matrix_bytes,
    matrix_of,
)
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe, make_features, make_scaleless_features

__all__ = ["GeneratedDrive", "GeneratedWorld", "circle", "first_view", "make_link", "straight"]

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
STEP_M = 0.1  # metres between two keyframes along a path
LINK_SIGMA_M = 0.01  # standard deviation of a loop closure along each axis, metres
LINK_SIGMA_DEG = 0.4  # standard deviation of a loop closure around each axis, degrees
SCALE_SIGMA = 0.03  # standard deviation of the logarithm of a measured scale
INFORMATION = np.diag([0.02**-2] * 3 + [math.radians(0.7) ** -2] * 3)


@dataclass(slots=True, eq=False)
class GeneratedDrive:
    """A robot that follows a path: its true poses, and its odometry, which drifts.

    With ``unit_m``, odometry and depths are in a unit of this many metres, which no event states.
    """

    robot: str
    T_world_camera: Array
    T_odom_camera: Array
    segment: int = 0
    unit_m: float | None = None


@dataclass(eq=False)
class GeneratedWorld:
    """Robots in one building.

    ``seen``, ``units_m`` and ``owners`` have the true pose, the unit, and (robot, number) of each keyframe by
    id.  Keyframes within ``reach_m`` metres overlap; at most ``links`` loop closures are made for each.  With
    ``twin_m``, the place at x looks like the place at x + ``twin_m`` metres.  Random wrong loop closures have
    ``wrong_inliers`` inliers.
    """

    seed: int
    features: int = 20
    reach_m: float = 0.6
    links: int = 4
    drift_m: float = 0.003
    drift_deg: float = 0.15
    twin_m: float | None = None
    wrong_inliers: int = 100
    seen: list[Array] = field(default_factory=list)
    units_m: list[float | None] = field(default_factory=list)
    owners: list[tuple[str, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        descriptors = self.rng.integers(0, 256, (self.features, 32), dtype=np.uint8)
        self._descriptors = descriptors
        self.wrong_sent = 0
        self._stack: Array = np.empty((0, 4, 4))
        self._stacked: tuple[list[Array], int] = ([], 0)

    def drive(
        self, robot: str, positions: Array, segment: int = 0, unit_m: float | None = None
    ) -> GeneratedDrive:
        """Return a robot's drive through ``(n, 2)`` positions, looking where it goes."""
        ahead = np.diff(positions, axis=0, append=positions[-1:] + (positions[-1:] - positions[-2:-1]))
        headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        true = np.array([_pose(x, y, yaw) for (x, y), yaw in zip(positions, headings, strict=True)])
        odometry = [np.eye(4)]
        sigma = np.array([self.drift_m] * 3 + [math.radians(self.drift_deg)] * 3)
        for one, other in pairwise(true):
            odometry.append(odometry[-1] @ inverse(one) @ other @ exp_se3(sigma * self.rng.normal(size=6)))
        return GeneratedDrive(
            robot=robot, T_world_camera=true, T_odom_camera=scaled(np.array(odometry), 1.0 / (unit_m or 1.0)),
            segment=segment, unit_m=unit_m,
        )  # fmt: skip

    def keyframe(self, drive: GeneratedDrive, number: int, first: int = 0) -> KeyframeAdded:
        """Return keyframe *number* of a drive as an event, and note its true pose."""
        self.seen.append(drive.T_world_camera[number])
        self.owners.append((drive.robot, number))
        self.units_m.append(drive.unit_m)
        pixels = self.rng.uniform(0, 470, (self.features, 2))
        depths_m = self.rng.uniform(1, 4, self.features)
        keyframe = SentKeyframe(
            timestamp_s=0.2 * number, T_odom_camera=drive.T_odom_camera[number], camera=CAMERA,
            features=make_features(pixels, depths_m, self._descriptors) if drive.unit_m is None
            else make_scaleless_features(pixels, depths_m / drive.unit_m, self._descriptors),
        )  # fmt: skip
        return KeyframeAdded(
            robot=drive.robot, segment=drive.segment, number=first + number, data=encode_keyframe(keyframe)
        )

    def links_of(self, keyframe: int, wrong: float = 0.0) -> LoopClosuresMeasured:
        """Return the loop closures of the newest keyframe with those that it truly overlaps.

        *wrong* is the probability of one more loop closure, which is random.
        """
        poses = self._poses(keyframe)
        links = []
        if len(poses):
            apart = np.sqrt(((poses[:, :3, 3] - self.seen[keyframe][:3, 3]) ** 2).sum(axis=1))
            facing = poses[:, :3, 2] @ self.seen[keyframe][:3, 2]
            near = np.flatnonzero((apart < self.reach_m) & (facing > math.cos(math.radians(40.0))))
            near = near[near < keyframe - 3]
            chosen = near[np.argsort(apart[near], kind="stable")[: self.links]]
            links = [self.true_link(keyframe, int(i)) for i in chosen]
            for shift in () if self.twin_m is None else (-self.twin_m, self.twin_m):
                links += self._links_to_twin(keyframe, poses, shift)
            if self.rng.uniform() < wrong:
                other = int(self.rng.integers(0, keyframe))
                self.wrong_sent += 1
                off = exp_se3(np.r_[self.rng.uniform(-3, 3, 3), self.rng.uniform(-1.5, 1.5, 3)])
                made = make_link(other, self.step(keyframe, other) @ off, self.wrong_inliers)
                links.append(self.in_units(keyframe, made))
        return LoopClosuresMeasured(keyframe=keyframe, links=tuple(links))

    def _poses(self, count: int) -> Array:
        """Return the first *count* poses of ``seen`` as an array ``(count, 4, 4)``."""
        of, known = self._stacked
        if of is not self.seen:  # a copy of a world drives on by itself
            self._stack, known = np.empty((0, 4, 4)), 0
        if count > len(self._stack):
            grown = np.empty((max(64, 2 * count), 4, 4))
            grown[:known] = self._stack[:known]
            self._stack = grown
        if count > known:
            self._stack[known:count] = self.seen[known:count]
            known = count
        self._stacked = self.seen, known
        return self._stack[:count]

    def _links_to_twin(self, keyframe: int, poses: Array, shift: float) -> list[MeasuredLoopClosure]:
        """Return loop closures with keyframes at the place that looks like that of *keyframe*."""
        shifted = self.seen[keyframe].copy()
        shifted[0, 3] += shift
        apart = np.sqrt(((poses[:, :3, 3] - shifted[:3, 3]) ** 2).sum(axis=1))
        near = np.flatnonzero((apart < self.reach_m) & (poses[:, :3, 2] @ shifted[:3, 2] > 0.77))
        chosen = near[np.argsort(apart[near], kind="stable")[: self.links]]
        sigma = np.array([LINK_SIGMA_M] * 3 + [math.radians(LINK_SIGMA_DEG)] * 3)
        return [
            make_link(int(i), inverse(shifted) @ poses[i] @ exp_se3(sigma * self.rng.normal(size=6)))
            for i in chosen
        ]

    def step(self, keyframe: int, other: int) -> Array:
        """Return the true pose of *other* relative to *keyframe*."""
        step: Array = inverse(self.seen[keyframe]) @ self.seen[other]
        return step

    def true_link(self, keyframe: int, other: int) -> MeasuredLoopClosure:
        """Return a loop closure as PnP measures it: the true relative pose with noise."""
        sigma = np.array([LINK_SIGMA_M] * 3 + [math.radians(LINK_SIGMA_DEG)] * 3)
        link = make_link(other, self.step(keyframe, other) @ exp_se3(sigma * self.rng.normal(size=6)))
        return self.in_units(keyframe, link)

    def in_units(self, keyframe: int, link: MeasuredLoopClosure, ratio: float = 1.0) -> MeasuredLoopClosure:
        """Return a loop closure in metres in the units of both keyframes, its scale wrong by *ratio*."""
        here, there = self.units_m[keyframe], self.units_m[link.other]
        if here is None and there is None:
            return link
        T, information = matrix_of(link.T_keyframe_other, 4, 4), matrix_of(link.information, 6, 6)
        if here is not None and there is not None:
            T, stretch = scaled(T, 1.0 / here), np.array([here] * 3 + [1.0] * 3)
            information = stretch[:, None] * information * stretch
        log_ratio = math.log((there or 1.0) / (here or 1.0) * ratio) + SCALE_SIGMA * self.rng.normal()
        return msgspec.structs.replace(
            link, T_keyframe_other=matrix_bytes(T), information=matrix_bytes(information),
            scale=(log_ratio, SCALE_SIGMA**2),
        )  # fmt: skip

    def play(
        self, drives: list[GeneratedDrive], wrong: float = 0.0
    ) -> Iterator[KeyframeAdded | LoopClosuresMeasured]:
        """Yield the events of robots that drive at the same time."""
        for number in range(max(len(drive.T_world_camera) for drive in drives)):
            for drive in drives:
                if number < len(drive.T_world_camera):
                    yield self.keyframe(drive, number)
                    yield self.links_of(len(self.seen) - 1, wrong)


def first_view(
    robot: str,
    segment: int = 0,
    number: int = 0,
    T_odom_camera: Array | None = None,
    *,
    is_metric: bool = True,
) -> KeyframeAdded:
    """Return a keyframe with two features as an event, at the origin of its odometry by default."""
    pixels, depths, descriptors = np.array([[9.0, 9.0], [9.0, 99.0]]), np.ones(2), np.zeros((2, 32), np.uint8)
    make = make_features if is_metric else make_scaleless_features
    keyframe = SentKeyframe(
        timestamp_s=0.0,
        T_odom_camera=np.eye(4) if T_odom_camera is None else T_odom_camera,
        camera=CAMERA,
        features=make(pixels, depths, descriptors),
    )
    return KeyframeAdded(robot=robot, segment=segment, number=number, data=encode_keyframe(keyframe))


def make_link(other: int, T_keyframe_other: Array, inliers: int = 100) -> MeasuredLoopClosure:
    """Return a loop closure with INFORMATION as its information; two thirds of its matches are inliers."""
    return MeasuredLoopClosure(
        other=other, T_keyframe_other=matrix_bytes(T_keyframe_other), information=matrix_bytes(INFORMATION),
        inliers=inliers, matches=3 * inliers // 2,
    )  # fmt: skip


def circle(radius_m: float, rounds: float, phase: float = 0.0, x: float = 0.0, y: float = 0.0) -> Array:
    """Return ``(n, 2)`` positions, a step apart, on a circle."""
    count = int(2 * math.pi * radius_m * rounds / STEP_M)
    angles = phase + np.arange(count) * STEP_M / radius_m
    return np.column_stack([x + radius_m * np.cos(angles), y + radius_m * np.sin(angles)])


def straight(begin_m: float, end_m: float) -> Array:
    """Return ``(n, 2)`` positions, a step apart, along x."""
    x = np.arange(begin_m, end_m, STEP_M)
    return np.column_stack([x, np.zeros(len(x))])


def _pose(x: float, y: float, yaw: float) -> Array:
    """Return the pose of a camera that looks along *yaw*; z of the world points up."""
    c, s = math.cos(yaw), math.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    T[:3, 3] = (x, y, 1.2)
    return T
