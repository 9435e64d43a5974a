"""Frames of a camera that is shaken, rotates about its centre, or moves past a plane, made of one image.

The same arguments give the same frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame
from client_sdk.simulator import render_frames
from rse_pf.geometry import Array, Camera, exp_so3
from rse_pf.images import load_opencv

Image = npt.NDArray[np.uint8]

RATE_HZ = 10.0  # frames per second of the generated drives
NOISE = 2.0  # standard deviation of the noise of each pixel, the same in all colours, in grey levels of 255
GAIN = 0.03  # standard deviation of the brightness of a frame, as a share of the brightness of the scene
OFFSET = 2.0  # standard deviation of the level that is added to all pixels of a frame, in grey levels
SHAKE_DEG = 0.1  # standard deviation of the rotation of a camera at rest about each axis, in each frame
PATCH_SPEED_PX = (2.0, 6.0)  # slowest and fastest motion of a patch from frame to frame, along each axis
ROTATION_FRAMES = 120  # number of frames of a camera that rotates
ROTATION_DEG = (5.0, 15.0, 3.0)  # amplitudes of the rotation about x (pitch), y (yaw) and z (roll)
ROTATION_PERIOD_S = 6.0  # period of the yaw, which turns by at most 1.6 deg from frame to frame
PLANE_M = 2.0  # depth of a plane in the middle of the scene's image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """One image, and the camera that took it."""

    name: str
    rgb: Image
    camera: Camera


def scene_of(data: Path, name: str, seed: int) -> Scene:
    """Return an image of a recording, or of a rendered room, that the seed chooses."""
    if name == "rendered":
        frame = next(render_frames(seed % 3, 3, 1, 40 + seed))
    else:
        dataset = open_dataset(data / name, camera="left", imu=False)
        frame = dataset.read(int(np.random.default_rng([seed, 6]).choice(dataset.rows)))
    return Scene(name=name, rgb=frame.rgb, camera=frame.camera)


def swaying(count: int, degrees: Array, period_s: float, rng: np.random.Generator) -> Array:
    """Return poses ``(n, 4, 4)`` that sway about x, y and z by some degrees, with periods that differ."""
    periods_s = period_s * np.array([1.3, 1.0, 1.7])
    phases = 2.0 * np.pi * (np.arange(count)[:, None] / RATE_HZ / periods_s + rng.uniform(size=3))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = [exp_so3(each) for each in np.radians(degrees) * np.sin(phases)]
    return poses


def photograph(
    scene: Scene,
    T_scene_camera: Array,
    number: int,
    rng: np.random.Generator,
    *,
    tilt_deg: float = 0.0,
    k1: float = 0.0,
) -> Frame:
    """Return the frame of a camera before the plane that shows the image of a scene, with light and noise.

    Beyond its edges the image is continued as its mirror image.

    Args:
        scene: The image, as the camera sees it from the pose of identity.
        T_scene_camera: Pose of the camera, metres.
        number: Number of the frame, which gives its time.
        rng: Random generator of light and noise.
        tilt_deg: Angle of the plane with the image, about y.
        k1: Radial distortion of the camera.
    """
    cv2, camera = load_opencv(), scene.camera
    # 1. Look up each pixel at the place where its ray meets the plane: a homography.
    normal = np.array([np.sin(np.radians(tilt_deg)), 0.0, np.cos(np.radians(tilt_deg))])
    rotation, position = T_scene_camera[:3, :3], T_scene_camera[:3, 3]
    distance_m = PLANE_M * normal[2] - normal @ position
    to_plane = (np.outer(position, normal) + distance_m * np.eye(3)) @ rotation
    clean = cv2.warpPerspective(
        scene.rgb,
        camera.matrix @ to_plane @ np.linalg.inv(camera.matrix),
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    # 2. Distort the image.
    if k1:
        columns, lines = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        pixels = np.stack([columns, lines], axis=-1).reshape(-1, 1, 2)
        coefficients = np.array([k1, 0.0, 0.0, 0.0])
        undistorted = cv2.undistortPoints(pixels, camera.matrix, coefficients, P=camera.matrix)
        places = undistorted.reshape(*columns.shape, 2).astype(np.float32)
        clean = cv2.remap(clean, places, None, cv2.INTER_LINEAR)
    # 3. Change the light, and add noise.
    lit = (1.0 + GAIN * rng.standard_normal()) * clean.astype(np.float32) + OFFSET * rng.standard_normal()
    noisy = lit + NOISE * rng.standard_normal((*clean.shape[:2], 1), dtype=np.float32)
    return Frame(
        timestamp_s=number / RATE_HZ,
        rgb=np.clip(np.rint(noisy), 0, 255).astype(np.uint8),
        depth_m=np.zeros(clean.shape[:2], dtype=np.float32),
        camera=camera,
    )


def patch_of(other: Scene, scene: Scene, share: float) -> Image:
    """Return the middle of another scene's image, with a *share* of the pixels of *scene*."""
    width, height = (round(share**0.5 * side) for side in (scene.camera.width, scene.camera.height))
    left, top = (other.camera.width - width) // 2, (other.camera.height - height) // 2
    return other.rgb[top : top + height, left : left + width]


def resting_frames(scene: Scene, count: int, seed: int, patch: Image | None = None) -> Iterator[Frame]:
    """Yield the frames of a shaken camera at rest, before which a patch may move to and fro."""
    rng = np.random.default_rng([seed, 1])
    height, width = (0, 0) if patch is None else patch.shape[:2]
    room = np.array([scene.camera.width - width, scene.camera.height - height])
    begin, step = rng.uniform(0.0, 2.0 * room), rng.uniform(*PATCH_SPEED_PX, size=2)
    for number in range(count):
        rgb = scene.rgb.copy()
        if patch is not None:
            x, y = np.rint(np.abs((begin + number * step) % (2.0 * room) - room)).astype(int)
            rgb[y : y + height, x : x + width] = patch
        pose = np.eye(4)
        pose[:3, :3] = exp_so3(np.radians(SHAKE_DEG) * rng.standard_normal(3))
        yield photograph(replace(scene, rgb=rgb), pose, number, rng)


def rotating_frames(scene: Scene, seed: int, focal_factor: float = 1.0, k1: float = 0.0) -> Iterator[Frame]:
    """Yield the frames of a camera that rotates about its centre.

    The cameras of the frames state *focal_factor* times the true focal lengths, and no distortion instead of
    *k1*.
    """
    rng, camera = np.random.default_rng([seed, 3]), scene.camera
    stated = Camera(
        fx=focal_factor * camera.fx, fy=focal_factor * camera.fy, cx=camera.cx, cy=camera.cy,
        width=camera.width, height=camera.height,
    )  # fmt: skip
    poses = swaying(ROTATION_FRAMES, np.array(ROTATION_DEG), ROTATION_PERIOD_S, rng)
    for number, pose in enumerate(poses):
        yield replace(photograph(scene, pose, number, rng, k1=k1), camera=stated)
