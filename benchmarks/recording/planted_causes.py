"""Recorded commands with one planted cause each, from rendered worlds and from real recordings.

A sequence of frames becomes a short history of commands and one command to explain, as `explain` takes them.
The label stays outside of what `explain` sees.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Features, Frame, FrontEndOptions, extract, load_opencv, match
from client_sdk.simulator import RATE_HZ, render_frames, true_trajectory
from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.recording.explain import Cause, PastCommand, Timing

__all__ = [
    "PLANTED",
    "RecordedCase",
    "Sequence",
    "healthy_case",
    "load_sequence",
    "plant_case",
    "render_sequence",
]

PLANTED = (
    Cause.MIRRORED, Cause.INTRINSICS, Cause.ROW_ORDER, Cause.OUTLIERS, Cause.DUPLICATES, Cause.PLANE,
    Cause.BLUR, Cause.DEPTH_SCALE, Cause.STALE_MAP, Cause.LATE,
)  # fmt: skip
FRAMES = 7
_OPTIONS = FrontEndOptions()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sequence:
    """Consecutive frames with their true poses."""

    name: str
    frames: tuple[Frame, ...]
    T_world_camera: Array
    period_s: float
    features: tuple[Features, ...]
    thumbnails: tuple[bytes, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """The payload of one command, in the shape of a request."""

    points_world: Array
    pixels: Array
    camera: Camera
    options: PnpOptions
    depths_m: Array | None
    T_camera_world: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedCase:
    """What `explain` sees of one command, and apart from it how far the pose is from the truth."""

    query: Query
    reply: PnpSolution | None
    thumbnail: bytes | None
    history: tuple[PastCommand, ...]
    timing: Timing | None
    T_odom_camera: Array | None
    error_m: float
    error_deg: float
    kind: str
    origin: str


def render_sequence(seed: int) -> Sequence:
    """Return a sequence of a rendered world; *seed* chooses world, place and speed."""
    rng = np.random.default_rng([seed, 1])
    robots, stride = int(rng.integers(5, 40)), int(rng.integers(1, 3))
    robot, count = int(rng.integers(0, robots)), FRAMES * stride
    frames = list(render_frames(robot, robots, count, seed))[::stride]
    poses = true_trajectory(robot, robots, count, seed).T_world_camera[::stride]
    return _sequence(f"rendered {seed}", tuple(frames), np.asarray(poses), stride / RATE_HZ)


def load_sequence(folder: Path, seed: int, *, share: tuple[float, float]) -> Sequence:
    """Return a part of a real recording, from within *share* of it."""
    dataset = open_dataset(folder)
    rng = np.random.default_rng([seed, 2])
    low, high = (round(part * len(dataset)) for part in share)
    stride = int(rng.integers(1, 3)) if high - low >= 2 * FRAMES else 1
    start = int(rng.integers(low, max(low + 1, high - stride * FRAMES + 1)))
    rows = list(range(start, high, stride))[:FRAMES]
    assert dataset.truth is not None
    known = np.asarray(dataset.truth.timestamps_s)
    frames = tuple(dataset.read(row) for row in rows)
    nearest = [int(np.argmin(np.abs(known - frame.timestamp_s))) for frame in frames]
    poses = np.asarray(dataset.truth.T_world_camera)[nearest]
    period_s = float(np.median(np.diff([frame.timestamp_s for frame in frames])))
    return _sequence(f"{folder.name} {start}+{stride}", frames, poses, period_s)


def _sequence(name: str, frames: tuple[Frame, ...], T_world_camera: Array, period_s: float) -> Sequence:
    return Sequence(
        name=name, frames=frames, T_world_camera=T_world_camera, period_s=period_s,
        features=tuple(extract(frame, _OPTIONS) for frame in frames),
        thumbnails=tuple(map(_thumbnail, frames)),
    )  # fmt: skip


def healthy_case(sequence: Sequence, seed: int) -> RecordedCase:
    """Return a command of *sequence* with nothing planted, some of it without some of the evidence."""
    rng = np.random.default_rng([seed, 3])
    case = _Recorder(sequence, rng).case(None, 0)
    lacking = rng.random(3) < 0.1
    return replace(
        case, thumbnail=None if lacking[0] else case.thumbnail, history=() if lacking[1] else case.history,
        timing=None if lacking[2] else case.timing,
    )  # fmt: skip


def plant_case(sequence: Sequence, seed: int, cause: Cause, severity: int) -> RecordedCase:
    """Return a command of *sequence* with *cause* planted, of *severity* 1, 2 or 3."""
    return _Recorder(sequence, np.random.default_rng([seed, 4])).case(cause, severity)


class _Recorder:
    """Make the commands of a sequence as a robot sends them; the random generator decides their kind."""

    def __init__(self, sequence: Sequence, rng: np.random.Generator) -> None:
        self.sequence, self.rng = sequence, rng
        self.is_pair = bool(rng.random() < 0.5)
        self.back = 1 if self.is_pair else int(rng.integers(1, 3))
        self.inlier_px = float(rng.choice([3.0, 3.0, 8.0]))
        start = exp_se3(np.concatenate([rng.uniform(-3, 3, 3), rng.normal(size=3)]))
        self.T_map_world = start @ inverse(sequence.T_world_camera[0])

    def case(self, cause: Cause | None, severity: int) -> RecordedCase:
        sequence, rng = self.sequence, self.rng
        last = len(sequence.frames) - 1
        plant = _Plant(cause, severity, rng, self.is_pair)
        features, thumbnails = list(sequence.features), list(sequence.thumbnails)
        if cause is Cause.BLUR:
            blurred = plant.blur(sequence.frames[-1])
            features[-1], thumbnails[-1] = extract(blurred, _OPTIONS), _thumbnail(blurred)
        odometry = self._odometry()
        history: list[PastCommand] = []
        first_s = float(rng.uniform(1e3, 1e5))
        result: RecordedCase | None = None
        for k in range(1, last + 1):
            reference = max(0, k - self.back)
            matches = match(features[reference], features[k], _OPTIONS)
            query = self._query(matches, reference, k)
            query = plant.query(query, is_last=k == last)
            reply = _answer(query)
            sent_s = first_s + k * sequence.period_s + float(rng.uniform(0.005, 0.04))
            thumbnail = thumbnails[k]
            if k < last:
                history.append(PastCommand(
                    sent_s=sent_s, T_camera_world=None if reply is None else reply.T_camera_world,
                    T_odom_camera=odometry[k], matches=len(query.pixels),
                    inliers=0 if reply is None else len(reply.inliers), thumbnail=thumbnail,
                ))  # fmt: skip
                continue
            error = (np.inf, np.inf)
            if reply is not None:
                error = pose_difference(inverse(reply.T_camera_world), inverse(query.T_camera_world))
            result = RecordedCase(
                query=query, reply=reply, thumbnail=thumbnail, history=tuple(history),
                timing=plant.timing(first_s + k * sequence.period_s, sent_s, sequence.period_s),
                T_odom_camera=odometry[k], error_m=error[0], error_deg=error[1],
                kind=f"{plant.kind}{', pair' if self.is_pair else ', map'}", origin=sequence.name,
            )  # fmt: skip
        assert result is not None
        return result

    def _query(self, matches: Any, reference: int, k: int) -> Query:
        poses = self.sequence.T_world_camera
        T_camera_reference = inverse(poses[k]) @ poses[reference]
        points, T, depths = matches.points_world, T_camera_reference, matches.depths_m
        if not self.is_pair:
            T_map_reference = self.T_map_world @ poses[reference]
            points = transform(T_map_reference, points)
            T = inverse(self.T_map_world @ poses[k])
            depths = None
        elif self.rng.random() < 0.3:
            depths = None
        options = PnpOptions(inlier_px=self.inlier_px)
        return Query(
            points_world=points, pixels=matches.pixels, camera=self.sequence.frames[k].camera,
            options=options, depths_m=depths, T_camera_world=T,
        )  # fmt: skip

    def _odometry(self) -> list[Array]:
        """Return ``T_odom_camera`` of each frame: 2 % of the way and 0.15 degrees of noise a step."""
        rng, poses = self.rng, self.sequence.T_world_camera
        chain = [np.eye(4)]
        for before, after in pairwise(poses):
            step = inverse(before) @ after
            moved = float(np.linalg.norm(step[:3, 3]))
            noise = np.concatenate([
                rng.normal(size=3) * (0.02 * moved + 0.001), rng.normal(size=3) * np.radians(0.15)
            ])  # fmt: skip
            chain.append(chain[-1] @ step @ exp_se3(noise))
        return chain


class _Plant:
    """One cause at one severity; None plants nothing."""

    def __init__(self, cause: Cause | None, severity: int, rng: np.random.Generator, is_pair: bool) -> None:
        self.cause, self.level, self.rng, self.is_pair = cause, severity - 1, rng, is_pair
        self.kind = ""
        self.every = cause in (Cause.MIRRORED, Cause.INTRINSICS, Cause.DEPTH_SCALE)
        if cause is not None:
            self._choose(cause)

    def _choose(self, cause: Cause) -> None:
        rng, level = self.rng, self.level
        if cause is Cause.MIRRORED:
            self.kind = str(rng.choice(["x", "y", "z", "image"]))
        elif cause is Cause.INTRINSICS:
            self.kind = str(rng.choice(["focal", "focal", "centre", "size" if level == 2 else "focal"]))
            self.sign = float(rng.choice([-1.0, 1.0]))
            self.angle = float(rng.uniform(0, 2 * np.pi))
        elif cause is Cause.ROW_ORDER:
            self.kind = ("block", str(rng.choice(["shifted", "reversed"])), "shuffled")[level]
        elif cause is Cause.OUTLIERS:
            self.kind = str(rng.choice(["anywhere", "other features"]))
        elif cause is Cause.DUPLICATES:
            self.kind = str(rng.choice(["exact", "trembling", "one group"]))
        elif cause is Cause.PLANE:
            self.kind = ("wall far away", "small poster", "strip")[level]
        elif cause is Cause.BLUR:
            self.kind = str(rng.choice(["motion", "focus"]))
        elif cause is Cause.DEPTH_SCALE:
            self.kind = str(rng.choice(["all", "points only"])) if self.is_pair else "map"
            factor = (1.25, 1.6, 2.5)[level]
            self.scale = factor if rng.random() < 0.5 else 1.0 / factor
        elif cause is Cause.STALE_MAP:
            self.kind = ("8 cm", "20 cm", "50 cm")[level]
        elif cause is Cause.LATE:
            self.kind = str(rng.choice(["answer", "frame", "clock ahead"]))

    def blur(self, frame: Frame) -> Frame:
        """Return the frame, blurred by a motion or out of focus."""
        cv2 = load_opencv()
        if self.kind == "focus":
            rgb = cv2.GaussianBlur(frame.rgb, (0, 0), (3.0, 5.0, 8.0)[self.level])
        else:
            length = (11, 19, 31)[self.level]
            kernel = np.zeros((length, length), dtype=np.float32)
            angle = self.rng.uniform(0, np.pi)
            for t in np.linspace(-1, 1, 4 * length):
                at = np.rint((length - 1) / 2 * (1 + t * np.array([np.sin(angle), np.cos(angle)]))).astype(
                    int
                )
                kernel[at[0], at[1]] = 1.0
            rgb = cv2.filter2D(frame.rgb, -1, kernel / kernel.sum())
        return replace(frame, rgb=rgb)

    def query(self, query: Query, *, is_last: bool) -> Query:
        """Return the command with the cause in it."""
        if self.cause is None or not (is_last or self.every):
            return query
        by_cause = {
            Cause.MIRRORED: self._mirror, Cause.INTRINSICS: self._intrinsics,
            Cause.ROW_ORDER: self._row_order, Cause.OUTLIERS: self._outliers,
            Cause.DUPLICATES: self._duplicates, Cause.PLANE: self._plane,
            Cause.DEPTH_SCALE: self._depth_scale, Cause.STALE_MAP: self._stale_map,
        }  # fmt: skip
        change = by_cause.get(self.cause)
        return query if change is None else change(query)

    def timing(self, frame_s: float, sent_s: float, period_s: float) -> Timing:
        """Return the times of the command; the server's clock is another one."""
        rng = self.rng
        trip_s = float(0.003 + rng.gamma(2.0, 0.01))
        if self.cause is Cause.LATE:
            late_s = (0.5, 1.0, 3.0)[self.level] * float(rng.uniform(1.0, 1.5)) + 1.25 * period_s
            if self.kind == "answer":
                trip_s += late_s
            elif self.kind == "frame":
                frame_s -= late_s
            else:
                frame_s += late_s
        received_s = sent_s + 0.4 * trip_s + float(rng.uniform(-0.01, 0.01)) + 17.0
        return Timing(
            frame_s=frame_s, sent_s=sent_s, answered_s=sent_s + trip_s, received_s=received_s,
            replied_s=received_s + 0.002, period_s=period_s,
        )  # fmt: skip

    def _mirror(self, query: Query) -> Query:
        worse = replace(query, pixels=self._stray(query, (0.0, 0.25, 0.45)[self.level], "anywhere"))
        if self.kind == "image":
            flipped = worse.pixels * [-1.0, 1.0] + [query.camera.width - 1.0, 0.0]
            return replace(worse, pixels=flipped)
        signs = np.array([-1.0 if axis == self.kind else 1.0 for axis in "xyz"])
        return replace(worse, points_world=query.points_world * signs)

    def _intrinsics(self, query: Query) -> Query:
        camera = query.camera
        if self.kind == "size":
            wrong = _camera(camera, 2.0**self.sign, (camera.cx * 2.0**self.sign, camera.cy * 2.0**self.sign))
        elif self.kind == "centre":
            shift = (40.0, 80.0, 140.0)[self.level] * np.array([np.cos(self.angle), np.sin(self.angle)])
            wrong = _camera(camera, 1.0, (camera.cx + shift[0], camera.cy + shift[1]))
        else:
            factor = (1.12, 1.3, 1.7)[self.level] ** self.sign
            wrong = _camera(camera, factor, (camera.cx, camera.cy))
        points = query.points_world
        if self.is_pair and self.rng.random() < 0.5:
            # The reference camera had the same wrong intrinsics, so its points are distorted by them.
            points = wrong.back_project(camera.project(points), points[:, 2])
        return replace(query, camera=wrong, points_world=points)

    def _row_order(self, query: Query) -> Query:
        n = len(query.pixels)
        order = np.arange(n)
        shift = int(self.rng.integers(1, 4))
        if self.kind == "block":
            start = int(n * self.rng.uniform(0.3, 0.5))
            order[start:] = np.roll(order[start:], shift)
        elif self.kind == "shifted":
            order = np.roll(order, shift)
        elif self.kind == "reversed":
            order = order[::-1]
        else:
            order = self.rng.permutation(n)
        return replace(query, pixels=query.pixels[order])

    def _stray(self, query: Query, share: float, kind: str) -> Array:
        n = len(query.pixels)
        wrong = self.rng.permutation(n)[: round(share * n)]
        pixels = query.pixels.copy()
        size = [query.camera.width, query.camera.height]
        if kind == "anywhere":
            pixels[wrong] = self.rng.uniform(0, size, (len(wrong), 2))
        else:  # wrong ones lie where features are, but not on those of the other rows
            others = query.pixels[self.rng.integers(0, n, len(wrong))]
            pixels[wrong] = others + self.rng.normal(size=(len(wrong), 2)) * 25.0
        return pixels

    def _outliers(self, query: Query) -> Query:
        return replace(query, pixels=self._stray(query, (0.6, 0.7, 0.85)[self.level], self.kind))

    def _duplicates(self, query: Query) -> Query:
        n = len(query.pixels)
        share = (0.5, 0.7, 0.9)[self.level]
        sources = self.rng.permutation(n)[: max(6, round((1 - share) * n))]
        copied = sources[: 1 if self.kind == "one group" else max(2, len(sources) // 4)]
        rows = np.sort(np.concatenate([sources, self.rng.choice(copied, n - len(sources))]))
        pixels, points = query.pixels[rows], query.points_world[rows]
        if self.kind == "trembling":
            pixels = pixels + self.rng.normal(size=pixels.shape) * 0.05
        depths = None if query.depths_m is None else query.depths_m[rows]
        return replace(query, pixels=pixels, points_world=points, depths_m=depths)

    def _plane(self, query: Query) -> Query:
        """Replace the scene by a wall with features on it, seen with the noise of the depth camera."""
        rng, camera, T = self.rng, query.camera, query.T_camera_world
        count, distance_m = ((120, 5.5), (60, 3.0), (60, 2.5))[self.level]
        half = ((150.0, 110.0), (45.0, 35.0), (200.0, 3.0))[self.level]
        centre = np.array([camera.cx, camera.cy]) + rng.uniform(-60, 60, 2)
        pixels = centre + rng.uniform(-1, 1, (count, 2)) * half
        normal = np.array([*rng.normal(size=2) * 0.2, 1.0])
        rays = camera.back_project(pixels, np.ones(count))
        depths = distance_m / (rays @ normal)
        seen = camera.back_project(pixels + rng.normal(size=pixels.shape) * 0.5, depths)
        noisy = depths + rng.normal(size=count) * (0.0012 + 0.0019 * (depths - 0.4) ** 2)
        points = transform(inverse(T), seen * (noisy / depths)[:, None])
        observed = pixels + rng.normal(size=pixels.shape) * 0.7
        wrong = rng.random(count) < 0.15
        observed[wrong] = rng.uniform(0, [camera.width, camera.height], (int(wrong.sum()), 2))
        order = np.argsort(observed[:, 0])
        return replace(
            query, points_world=np.round(points[order], 4), pixels=np.round(observed[order], 2),
            depths_m=None if query.depths_m is None else np.round(noisy[order], 3),
        )  # fmt: skip

    def _depth_scale(self, query: Query) -> Query:
        depths = query.depths_m
        if depths is not None and self.kind == "all":
            depths = depths * self.scale
        return replace(query, points_world=query.points_world * self.scale, depths_m=depths)

    def _stale_map(self, query: Query) -> Query:
        rng, points = self.rng, query.points_world.copy()
        centre = points[rng.integers(len(points))]
        near = np.argsort(np.linalg.norm(points - centre, axis=1))
        moved = near[: round(rng.uniform(0.25, 0.45) * len(points))]
        direction = rng.normal(size=3)
        shift_m = (0.08, 0.2, 0.5)[self.level]
        middle = points[moved].mean(axis=0)
        turn = exp_se3(np.concatenate([np.zeros(3), rng.normal(size=3) * 0.05]))[:3, :3]
        shift = shift_m * direction / np.linalg.norm(direction)
        points[moved] = (points[moved] - middle) @ turn.T + middle + shift
        return replace(query, points_world=points)


def _camera(camera: Camera, factor: float, centre: tuple[float, float]) -> Camera:
    return Camera(
        fx=camera.fx * factor, fy=camera.fy * factor, cx=centre[0], cy=centre[1],
        width=camera.width, height=camera.height,
    )  # fmt: skip


def _answer(query: Query) -> PnpSolution | None:
    try:
        return solve_pnp(query.points_world, query.pixels, query.camera, query.options)
    except RsePfError:
        return None


def _thumbnail(frame: Frame) -> bytes:
    from PIL import Image

    picture: Any = Image.fromarray(frame.rgb)
    width = 160
    small = picture.resize((width, round(width * picture.height / picture.width)))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=70)
    return stream.getvalue()
