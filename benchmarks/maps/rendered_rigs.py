"""A rendered rig with exact truth: a stereo pair of distorted lenses and an IMU with noise, tracked.

    python -m benchmarks maps.rendered_rigs [--seeds 20] [--first 0] [--lens pinhole fisheye]

Each seed has a room, a motion, noise and biases of its own.  Both cameras are turned against each other and
have distorted lenses, radial-tangential or Kannala-Brandt; their images are rectified by the rig's own
calibration.  The clock of the IMU is 20 ms late, right, or 20 ms early.  Pairs are tracked as `Mapper` does,
poses solved in this process.

Defends: ATE at most 0.5 % of the path, no frame lost; biases within three of their deviations; the offset in
time is found within 3 ms, or the IMU is refused.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from client_sdk.frontend import Frame, load_opencv
from client_sdk.imu.samples import ImuSamples
from client_sdk.mapper import Mapper
from client_sdk.mapping import Trajectory
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import RigCamera, RigImu
from client_sdk.simulator.camera import Painter, add_image_noise
from client_sdk.simulator.inertial import InertialDrive, Motion, SimulatedImu
from client_sdk.simulator.world import DEPTH_M, ROOM_M, World, make_world
from rse_pf.config import PlatformSettings
from rse_pf.experiments.compare.solvers import InProcessSolver
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, Camera, exp_se3, inverse

__all__ = ["Driven", "LensKind", "RenderedRig", "drive_rig", "render_raw", "rendered_rig"]

LensKind = Literal["pinhole", "fisheye"]
ATE_PERCENT, DEVIATIONS, OFFSET_S = 0.5, 3.0, 0.003
OFFSETS_S = (0.02, 0.0, -0.02)
_SIZE = (480, 320)
_FOCAL_PX, _BASELINE_M, _HEIGHT_M = 290.0, 0.12, 1.45
_DISTORTIONS: dict[LensKind, tuple[float, ...]] = {
    "pinhole": (-0.28, 0.07, 2e-4, 2e-5),
    "fisheye": (-0.013, 0.006, -0.003, 0.0005),
}
_MOTION = Motion(reach_m=0.5, turn_rad=0.35, slowest_hz=0.08, fastest_hz=0.3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedRig:
    """Both cameras of a pair and an IMU on one body, of which the IMU is the origin."""

    left: RigCamera
    right: RigCamera
    imu: RigImu


@dataclass(frozen=True, slots=True, kw_only=True)
class Driven:
    """What tracking a drive gave.

    ``deviations`` is the largest error of a component of the biases in its standard deviations, None where
    the IMU was not used; ``offset_error_s`` that of the clock.
    """

    ate_cm: float
    path_m: float
    lost: int
    imu: str
    deviations: float | None
    offset_error_s: float | None
    took_s: float

    @property
    def percent(self) -> float:
        """The ATE as a share of the path."""
        return self.ate_cm / self.path_m

    @property
    def missed(self) -> list[str]:
        """The bars that were missed."""
        is_refused = self.imu.startswith("not used:")
        missed = {
            "ATE": not self.percent <= ATE_PERCENT,
            "lost": self.lost > 0,
            "biases": not is_refused and not (self.deviations or math.inf) <= DEVIATIONS,
            "offset": not is_refused and not abs(self.offset_error_s or 0.0) <= OFFSET_S,
        }
        return [name for name, is_missed in missed.items() if is_missed]


def rendered_rig(kind: LensKind) -> RenderedRig:
    """Return a pair whose cameras look along the x axis of the body, the right one turned by 0.9 degrees."""
    lens = Intrinsics(
        camera=Camera(
            fx=_FOCAL_PX, fy=_FOCAL_PX + 1.0, cx=_SIZE[0] / 2 - 3.0, cy=_SIZE[1] / 2 + 2.0,
            width=_SIZE[0], height=_SIZE[1],
        ),
        distortion=_DISTORTIONS[kind],
        model="fisheye" if kind == "fisheye" else "radial-tangential",
    )  # fmt: skip
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_body_left = T_body_left @ exp_se3(np.array([-0.05, 0.02, 0.03, 0.01, -0.015, 0.02]))
    T_left_right = exp_se3(np.array([_BASELINE_M, 0.001, -0.001, 0.008, -0.012, 0.006]))
    return RenderedRig(
        left=RigCamera(name="left", lens=lens, T_body_camera=T_body_left),
        right=RigCamera(name="right", lens=lens, T_body_camera=T_body_left @ T_left_right),
        imu=RigImu(
            T_body_imu=np.eye(4), gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3,
            rate_hz=200.0,
        ),
    )  # fmt: skip


class _LensPainter:
    """Renders what a lens shows: a wide pinhole image, of which each of its pixels takes its place."""

    def __init__(self, world: World, lens: Intrinsics) -> None:
        cv2 = load_opencv()
        camera = lens.camera
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        undistort = cv2.fisheye.undistortPoints if lens.model == "fisheye" else cv2.undistortPoints
        rays = undistort(pixels, camera.matrix, np.array(lens.distortion)).reshape(-1, 2)
        reach = np.abs(rays).max(axis=0) + 0.02
        # As fine as the lens in its middle, so that nothing is blurred.
        width, height = (2 * math.ceil(float(each) * camera.fx) + 2 for each in reach)
        wide = Camera(
            fx=camera.fx, fy=camera.fx, cx=width / 2 - 0.5, cy=height / 2 - 0.5, width=width, height=height
        )
        self._painter = Painter(world, wide)
        places = (rays * camera.fx + [wide.cx, wide.cy]).astype(np.float32)
        self._places = places.reshape(camera.height, camera.width, 2)

    def draw(self, T_world_camera: Array, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        cv2 = load_opencv()
        colour = self._painter.draw(T_world_camera)[0]
        return add_image_noise(cv2.remap(colour, self._places, None, cv2.INTER_LINEAR), rng)


def render(
    rig: RenderedRig,
    rectification: Rectification,
    world: World,
    T_world_body: Array,
    stamps_s: Array,
    seed: int,
) -> Iterator[Frame]:
    """Yield the rectified pairs of a body on ``(n, 4, 4)`` poses."""
    cv2 = load_opencv()
    for row, (left, right) in enumerate(render_raw(rig, world, T_world_body, seed)):
        yield Frame(
            timestamp_s=float(stamps_s[row]), rgb=rectification.left(left), camera=rectification.camera,
            depth_m=np.zeros(left.shape[:2], dtype=np.float32),
            stereo=rectification.right(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)),
        )  # fmt: skip


def render_raw(
    rig: RenderedRig, world: World, T_world_body: Array, seed: int
) -> Iterator[tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]]:
    """Yield the colours ``(h, w, 3)`` of the left and the right lens, as they are."""
    painters = [_LensPainter(world, each.lens) for each in (rig.left, rig.right)]
    for row, T in enumerate(T_world_body):
        rng = np.random.default_rng([seed, 73, row])
        left, right = (
            painter.draw(T @ each.T_body_camera, rng)
            for painter, each in zip(painters, (rig.left, rig.right), strict=True)
        )
        yield left, right


async def drive_rig(kind: LensKind, seed: int, seconds: float, rate_hz: float) -> Driven:
    """Render a drive, track it, and judge poses, biases and the offset in time."""
    began_s = time.process_time()
    rig = rendered_rig(kind)
    rectification = Rectification(rig.left, rig.right)
    drive = InertialDrive(rig.imu.model(rig.left.T_body_camera), _MOTION, seed)
    imu, late_s = SimulatedImu(drive, seconds, seed), OFFSETS_S[seed % len(OFFSETS_S)]
    model = rig.imu.model(rectification.T_body_camera)
    stamps_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    T_world_left = drive.T_world_camera(stamps_s)
    T_world_left[:, :3, 3] += [0.5 * ROOM_M, 0.5 * DEPTH_M, _HEIGHT_M]
    T_world_body = T_world_left @ inverse(rig.left.T_body_camera)
    truth = Trajectory(stamps_s, T_world_body @ rectification.T_body_camera)
    mapper = Mapper(ask=InProcessSolver(PlatformSettings()).ask, adds_frames=False)
    lost, last_s = 0, float(stamps_s[0]) - 0.2
    for frame in render(rig, rectification, make_world(seed), T_world_body, stamps_s, seed):
        now_s = frame.timestamp_s
        taken = imu.between(last_s, now_s)
        samples = ImuSamples(taken.timestamps_s + late_s, taken.gyro, taken.accel, model)
        tracked = await mapper.track(replace(frame, imu=samples))
        lost, last_s = lost + tracked.lost, now_s
    return _judged(mapper, imu, truth, late_s, lost, time.process_time() - began_s)


def _judged(
    mapper: Mapper, imu: SimulatedImu, truth: Trajectory, late_s: float, lost: int, took_s: float
) -> Driven:
    path, stamps_s = mapper.trajectory, truth.timestamps_s
    rows = np.searchsorted(stamps_s, path.timestamps_s - 1e-6)
    inertial = mapper._inertial
    assert inertial is not None
    found, deviations = inertial.alignment, None
    if found is not None:
        last = int(np.searchsorted(imu.timestamps_s, stamps_s[-1]))
        true = np.concatenate([imu.bias_gyro[last], imu.bias_accel[last]])
        biases = np.concatenate([found.bias_gyro[-1], found.bias_accel[-1]])
        deviations = float((np.abs(biases - true) / np.sqrt(np.diag(found.bias_covariance))).max())
    return Driven(
        ate_cm=100.0 * ate_m(path.T_world_camera, truth.T_world_camera[rows]),
        path_m=truth.length_m,
        lost=lost, imu=mapper.imu, deviations=deviations,
        offset_error_s=None if found is None else inertial.offset_s - late_s, took_s=took_s,
    )  # fmt: skip


@benchmark(
    Bar("*.percent.max", at_most=ATE_PERCENT, unit="% of the path"),
    Bar("*.missed", equals=0, unit="seeds"),
)
def run_benchmark(
    *, seeds: int = 20, first: Annotated[int, "the first of the seeds"] = 0,
    lens: Annotated[tuple[str, ...], "kinds of lenses", _DISTORTIONS] = tuple(_DISTORTIONS),
    seconds: float = 8.0, rate: float = 10.0,
) -> dict[str, Any]:  # fmt: skip
    """Drive all seeds with each kind of lenses."""
    load_opencv().setNumThreads(1)
    made: dict[str, list[Driven]] = {kind: [] for kind in lens}
    for seed in range(first, first + seeds):
        for kind in lens:
            made[kind].append(asyncio.run(drive_rig(kind, seed, seconds, rate)))
            say({"lens": kind, "seed": seed, **asdict(made[kind][-1]), "missed": made[kind][-1].missed})
    return {
        kind: {
            "percent": spread(run.percent for run in runs),
            "missed": sum(bool(run.missed) for run in runs),
            "runs": [{**asdict(run), "missed": run.missed} for run in runs],
        }
        for kind, runs in made.items()
    }
