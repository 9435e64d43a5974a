"""Read the unit of depth and the poses of the sensors from bags of the RealSense recorder.

Topics are those of librealsense's file format: ``/device_0/sensor_0/Depth_0/image/data`` has the images,
``/device_0/sensor_0/option/Depth_Units/value`` the metres of one unit of depth, and
``/device_0/sensor_0/Depth_0/tf/0`` the transform from the reference frame 0 to the sensor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from client_sdk.bags.bag_file import BagFile, BrokenMessage
from client_sdk.bags.message_types import FLOAT, TRANSFORM
from rse_pf.geometry import Array, from_quaternion, inverse

__all__ = ["stated_T_colour_depth", "stated_depth_unit_m"]

_IMAGE_TOPIC_ENDING = "/image/data"  # ending of the names of image topics


def stated_depth_unit_m(file: BagFile, depth: str) -> float | None:
    """Return the metres of one unit of the depth images of the topic *depth*; None if the bag states none."""
    stream = _stream_of(depth)
    if not stream:
        return None
    sensor = stream.rpartition("/")[0]
    message = _first(file, f"{sensor}/option/Depth_Units", FLOAT)
    # The message has a 32-bit float: 0.001 is read as 0.0010000000475, and rounded.
    unit_m = 0.0 if message is None else round(float(message.data), 9)
    return unit_m if math.isfinite(unit_m) and unit_m > 0.0 else None


def stated_T_colour_depth(file: BagFile, colour: str, depth: str) -> Array | None:
    """Return the transform ``(4, 4)``, metres, from the frame of the topic *depth* to that of *colour*.

    None if the bag does not state it.
    """
    mounts = [_first(file, f"{_stream_of(topic)}/tf/", TRANSFORM) for topic in (colour, depth)]
    if not (_stream_of(colour) and _stream_of(depth)) or mounts[0] is None or mounts[1] is None:
        return None
    T_colour_reference, T_depth_reference = (_matrix_of(mount) for mount in mounts)
    T_colour_depth: Array = T_colour_reference @ inverse(T_depth_reference)
    return T_colour_depth if np.isfinite(T_colour_depth).all() else None


def _stream_of(topic: str) -> str:
    return topic.removesuffix(_IMAGE_TOPIC_ENDING) if topic.endswith(_IMAGE_TOPIC_ENDING) else ""


def _first(file: BagFile, start: str, kind: str) -> Any | None:
    """Return the first message of the topics of type *kind* whose names begin with *start*.

    The result is None without such a message, or if it is malformed.
    """
    names = [topic.name for topic in file.topics if topic.kind == kind and topic.name.startswith(start)]
    try:
        return next((file.parse(raw) for raw in file.messages(names)), None)
    except BrokenMessage:
        return None


def _matrix_of(transform: Any) -> Array:
    T = np.eye(4)
    turn, step = transform.rotation, transform.translation
    T[:3, :3] = from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
    T[:3, 3] = step.x, step.y, step.z
    return T
