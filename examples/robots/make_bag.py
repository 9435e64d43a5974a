"""Write a recording, or rendered images with depth, as a ROS 1 bag that rosbag can play.

Needs rosbags: pip install 'rse-pf[bags]' installs it.
"""

import argparse
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.bags import BagWriter
from client_sdk.datasets import open_dataset
from client_sdk.simulator import render_frames

START_S = 1_700_000_000  # recordings may begin at 0, which is no time of ROS
IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("bag", type=Path, help="the bag to write")
parser.add_argument("--recording", type=Path, help="folder of a recording with depth (default: rendered)")
parser.add_argument("--frames", type=int, default=80, help="largest number of frames (default: 80)")


def image_message(bag: BagWriter, header: Any, image: Any, encoding: str) -> Any:
    """Return *image* as sensor_msgs/Image."""
    data = np.ascontiguousarray(image).view(np.uint8).reshape(-1)
    height, width = image.shape[:2]
    return bag.make(
        IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=data.size // height,
        data=data,
    )


def info_message(bag: BagWriter, header: Any, camera: Any) -> Any:
    """Return *camera* as sensor_msgs/CameraInfo."""
    region = "sensor_msgs/msg/RegionOfInterest"
    return bag.make(
        INFO,
        header=header,
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=camera.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack((camera.matrix, np.zeros((3, 1)))).ravel(),
        binning_x=0,
        binning_y=0,
        roi=bag.make(region, x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def main(args: argparse.Namespace) -> None:
    if args.recording is None:
        frames = render_frames(robot=0, robots=1, frames=args.frames, seed=0)
    else:
        frames = islice(open_dataset(args.recording), args.frames)
    with BagWriter(args.bag, "ros1") as bag:
        for frame in frames:
            stamp_ns = round((START_S + frame.timestamp_s) * 1e9)
            header = bag.header(stamp_ns, "camera_optical")
            colours = image_message(bag, header, frame.rgb, "rgb8")
            depth_mm = np.round(1000 * frame.depth_m).astype(np.uint16)
            depth = image_message(bag, header, depth_mm, "16UC1")
            bag.write("/camera/image_raw", IMAGE, stamp_ns, colours)
            bag.write("/camera/aligned_depth", IMAGE, stamp_ns, depth)
            bag.write("/camera/camera_info", INFO, stamp_ns, info_message(bag, header, frame.camera))


if __name__ == "__main__":
    main(parser.parse_args())
