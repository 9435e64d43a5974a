"""Cameras, videos and folders of images as iterators of frames, and camera calibration.

Tracking and mapping of the frames belong to `client_sdk.mapper`, recordings of benchmarks to
`client_sdk.datasets`.
"""

from client_sdk.cameras.open_camera import open_camera, source_of_recording
from client_sdk.cameras.source import FrameSource
from client_sdk.rigs.intrinsics import Intrinsics, write_intrinsics
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from client_sdk.rigs.rig_file import read_intrinsics, read_rig, write_rig

__all__ = [
    "FrameSource",
    "Intrinsics",
    "Rig",
    "RigCamera",
    "RigImu",
    "open_camera",
    "read_intrinsics",
    "read_rig",
    "source_of_recording",
    "write_intrinsics",
    "write_rig",
]
