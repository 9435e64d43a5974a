"""A rendered stereo pair of distorted lenses, turned against each other, and an IMU on one body."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import RigCamera, RigImu
from client_sdk.simulator.renderer import Renderer, add_image_noise
from client_sdk.simulator.world import World
from rse_pf.geometry import Array, Camera, exp_se3

_SIZE = (480, 320)
_FOCAL_PX, _BASELINE_M = 290.0, 0.12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedRig:
    """Both cameras of a pair and an IMU on one body, of which the IMU is the origin."""

    left: RigCamera
    right: RigCamera
    imu: RigImu


def rendered_rig() -> RenderedRig:
    """Return a pair whose cameras look along the x axis of the body, the right one turned by 0.9 degrees."""
    lens = Intrinsics(
        camera=Camera(
            fx=_FOCAL_PX, fy=_FOCAL_PX + 1.0, cx=_SIZE[0] / 2 - 3.0, cy=_SIZE[1] / 2 + 2.0,
            width=_SIZE[0], height=_SIZE[1],
        ),
        distortion=(-0.28, 0.07, 2e-4, 2e-5),
        model="radial-tangential",
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
        rays = cv2.undistortPoints(pixels, camera.matrix, np.array(lens.distortion)).reshape(-1, 2)
        reach = np.abs(rays).max(axis=0) + 0.02
        # As fine as the lens in its middle, so that nothing is blurred.
        width, height = (2 * math.ceil(float(each) * camera.fx) + 2 for each in reach)
        wide = Camera(
            fx=camera.fx, fy=camera.fx, cx=width / 2 - 0.5, cy=height / 2 - 0.5, width=width, height=height
        )
        self._painter = Renderer(world, wide)
        places = (rays * camera.fx + [wide.cx, wide.cy]).astype(np.float32)
        self._places = places.reshape(camera.height, camera.width, 2)

    def draw(self, T_world_camera: Array, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        cv2 = load_opencv()
        colour = self._painter.draw(T_world_camera)[0]
        return add_image_noise(cv2.remap(colour, self._places, None, cv2.INTER_LINEAR), rng)


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
