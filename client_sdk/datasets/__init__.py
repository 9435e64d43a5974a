"""Recordings as frames: TUM RGB-D layout, NYU Depth V2.

Readers belong here; what a robot does with a frame does not.
"""

from client_sdk.datasets.recordings import Dataset, associate_stamps, open_dataset, read_colour

__all__ = ["Dataset", "associate_stamps", "open_dataset", "read_colour"]
