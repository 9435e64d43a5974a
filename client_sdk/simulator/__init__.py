"""A rendered world for robots without a camera: exact poses and a Kinect's noise.

Rendering and trajectories belong here; reading recordings belongs to `datasets`.
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
    "true_trajectory",
]
