"""Cameras and recordings as iterators of frames: devices, videos, folders, RealSense; and their calibration.

Whatever yields a `Frame` belongs here; what a robot does with it does not.
"""

from client_sdk.cameras.open_camera import open_camera, source_of_frames
from client_sdk.cameras.source import FrameSource
from client_sdk.rigs.intrinsics import Intrinsics, read_intrinsics, write_intrinsics
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from client_sdk.rigs.rig_file import read_rig, write_rig

__all__ = [
    "FrameSource",
    "Intrinsics",
    "Rig",
    "RigCamera",
    "RigImu",
    "open_camera",
    "read_intrinsics",
    "read_rig",
    "source_of_frames",
    "write_intrinsics",
    "write_rig",
]
