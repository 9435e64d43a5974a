"""What the examples take, rendered: a video, two drives with depth, and a photo with an object and a tag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from client_sdk.cameras import Intrinsics, write_intrinsics
from client_sdk.simulator import true_trajectory
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.simulator.world import make_world
from rse_pf.geometry import Array, Camera

__all__ = ["COVER_WIDTH_M", "SCENE_CAMERA", "TAG_M", "draw_scene", "write_drives", "write_video"]

SMALL = Camera(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)
SCENE_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
COVER_WIDTH_M, TAG_M = 0.2, 0.1
STEP_M = 0.05
_SEED = 0
_ROBOTS = 40
"""So many robots share the loop of the world: neighbours start 0.7 m apart, and see the same."""
_LARGER = 4
"""Scenes are drawn larger by this, then averaged, as the pixels of a camera average."""


def write_video(path: Path, frames: int) -> None:
    """Write a video of a camera that moves to the right by `STEP_M` a frame, before a wall with pictures."""
    painter = Renderer(make_world(_SEED), SMALL)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T  # right, down, forward
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (SMALL.width, SMALL.height))
    for row in range(frames):
        pose[:3, 3] = [1.8 + STEP_M * row, 1.4, 1.3]
        colour, _, _ = painter.draw(pose)
        rgb = add_image_noise(colour, np.random.default_rng(row))
        writer.write(np.ascontiguousarray(rgb[:, :, ::-1]))
    writer.release()
    write_intrinsics(path.parent / "intrinsics.json", Intrinsics(camera=SMALL))


def write_drives(folders: list[Path], frames: int) -> None:
    """Write one folder of images with depth for each of some robots that follow each other."""
    painter = Renderer(make_world(_SEED), SMALL)
    for number, folder in enumerate(folders):
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)
        write_intrinsics(folder / "intrinsics.json", Intrinsics(camera=SMALL, depth_scale=1000.0))
        truth = true_trajectory(number, _ROBOTS, frames, _SEED)
        for row, pose in enumerate(truth.T_world_camera):
            rng = np.random.default_rng([number, row])
            colour, depth_m, cosine = painter.draw(pose)
            rgb = add_image_noise(colour, rng)
            depth = np.round(1e3 * add_depth_noise(depth_m, cosine, rng)).astype(np.uint16)
            cv2.imwrite(str(folder / "rgb" / f"{row}.png"), np.ascontiguousarray(rgb[:, :, ::-1]))
            cv2.imwrite(str(folder / "depth" / f"{row}.png"), depth)


def draw_scene(cover: Path, T_camera_cover: Array, T_camera_tag: Array, tag: int, seed: int) -> Any:
    """Return a grey photo ``(h, w)`` of the cover and a tag before a cluttered wall, with noise."""
    rng = np.random.default_rng(seed)
    camera = SCENE_CAMERA
    size = (_LARGER * camera.width, _LARGER * camera.height)
    coarse = rng.uniform(90, 190, (15, 20)).astype(np.float32)
    image = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(dictionary, tag, 400)
    paper = cv2.copyMakeBorder(marker, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    picture = cv2.imread(str(cover), cv2.IMREAD_GRAYSCALE)
    for drawn, width_m, T in (
        (picture, COVER_WIDTH_M, T_camera_cover),
        (paper, TAG_M * paper.shape[1] / marker.shape[1], T_camera_tag),
    ):
        H = _homography(T, drawn.shape, width_m)
        inside = cv2.warpPerspective(np.ones_like(drawn), H, size, flags=cv2.INTER_NEAREST).astype(bool)
        seen = cv2.warpPerspective(drawn, H, size, flags=cv2.INTER_LINEAR)
        image = np.where(inside, seen, image)
    small = cv2.resize(image.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noisy = small + rng.normal(size=small.shape) * 2.0
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _homography(T_camera_object: Array, shape: tuple[int, ...], width_m: float) -> Array:
    """Return the map from pixels of a picture to pixels of the larger image."""
    pixel_m = width_m / shape[1]
    to_metres = np.array(
        [[pixel_m, 0, -pixel_m * (shape[1] - 1) / 2], [0, pixel_m, -pixel_m * (shape[0] - 1) / 2], [0, 0, 1]]
    )
    shift = (_LARGER - 1) / 2  # the centre of the first pixel is 0 in both images
    larger = np.array([[_LARGER, 0, shift], [0, _LARGER, shift], [0, 0, 1]])
    H: Array = larger @ SCENE_CAMERA.matrix @ T_camera_object[:3, [0, 1, 3]] @ to_metres
    return H
