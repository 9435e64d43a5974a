"""A rendered world for robots without a camera: exact poses and a Kinect's noise.

Rendering and trajectories belong here; reading recordings belongs to `datasets`.
"""

from client_sdk.simulator.drive import (
    RATE_HZ,
    SIMULATED_CAMERA,
    STEP_M,
    frames_to_overlap,
    render_frames,
    true_trajectory,
)

__all__ = [
    "RATE_HZ",
    "SIMULATED_CAMERA",
    "STEP_M",
    "frames_to_overlap",
    "render_frames",
    "true_trajectory",
]
