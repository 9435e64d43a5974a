"""Read recordings as frames: the layouts of TUM RGB-D, EuRoC and KITTI, NYU Depth V2, and ROS bags.

Devices, videos and plain folders of images are read by `client_sdk.cameras`.
"""

from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import read_colour
from client_sdk.datasets.recordings import associate_stamps, open_dataset
from client_sdk.datasets.rig_recordings import CameraChoice

__all__ = ["CameraChoice", "Dataset", "associate_stamps", "open_dataset", "read_colour"]
