"""Render a furnished world for robots without a camera: exact poses, and images with the noise of a Kinect.

1. `world` makes the rooms and their furniture as textured rectangles.
2. `renderer` draws images and exact depths, and adds the noise of the sensors.
3. `drive` makes the trajectories of robots through the rooms, and yields the rendered frames.
4. `building` makes larger buildings, and `base` drives a robot on wheels through them, with its odometry.

The textures of both are made by `textures`.
"""

from client_sdk.simulator.drive import (
    RATE_HZ,
    SIMULATED_CAMERA,
    STEP_M,
    frames_to_overlap,
    loop_trajectory,
    render_along,
    render_frames,
    render_pairs,
    rendered_drive,
    true_trajectory,
)
from client_sdk.simulator.world import World, make_world

__all__ = [
    "RATE_HZ",
    "SIMULATED_CAMERA",
    "STEP_M",
    "World",
    "frames_to_overlap",
    "loop_trajectory",
    "make_world",
    "render_along",
    "render_frames",
    "render_pairs",
    "rendered_drive",
    "true_trajectory",
]
