"""What a bridge is told: by arguments of a command line, parameters of a launch file, or a program."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from rse_pf.errors import UsageError

__all__ = ["HELP", "BridgeOptions"]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_TRUE, _FALSE = ("true", "1", "yes"), ("false", "0", "no")
HELP = {
    "url": "address of the platform: ws://HOST:PORT/ws",
    "token_file": "file that holds the robot's token",
    "enrolment": "file of rse-pf robot enrol --out, instead of both",
    "namespace": "name of this robot, before its topics and frames",
    "map": "live map that it shares with other robots (default: a map of its own)",
    "colour": "topic of the colours",
    "depth": "topic of depth registered to them; empty: none",
    "info": "topic of the camera_info of the colours",
    "right": "topic of the right images of a stereo pair, instead of depth; empty: none",
    "right_info": "topic of the camera_info of the right images",
    "imu": "topic of an IMU; needs rig",
    "rig": "file of the rig, rig.json; empty: by both camera_info",
    "depth_scale": "units of a 16-bit depth image in a metre",
    "pair_within_s": "colour and depth belong together up to this difference of time",
    "queue_frames": "so many frames wait while another is tracked",
    "map_frame": "name of the frame of the map",
    "odom_frame": "name of the odometry frame",
    "camera_frame": "name of the camera's frame (default: as in the images)",
    "publish_odom": "whether to publish the transform from odometry frame to camera",
    "cloud_every_s": "time between two clouds",
    "path_poses": "most poses of a path",
    "out": "folder that the service save writes to",
    "publish_as": "name of the map that the service publish makes of a map of its own",
    "localise_in": "name of the map in which the service localise looks",
}
"""What each option is, for a command line and for the description of a parameter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeOptions:
    """How a robot of ROS takes part.

    Attributes:
        url: Address of the platform, ``ws://HOST:PORT/ws``.
        token_file: File that holds the robot's token; it is read again for each connection.
        enrolment: File of ``rse-pf robot enrol --out``, instead of both.
        namespace: Of this robot, such as ``robot1``: before the names of its topics and its odometry frame.
        map: Name of the live map that it shares with others; empty: a map of its own.
        colour: Topic of the colours: ``Image``, or ``CompressedImage`` if its name ends with ``compressed``.
        depth: Topic of depth that is registered to the colours, ``compressedDepth`` likewise; empty: none.
        info: Topic of the ``CameraInfo`` of the colours.
        right: Topic of the right images of a stereo pair, whose left ones are the colours; then depth is not
            used.  Empty: no pair.
        right_info: Topic of the ``CameraInfo`` of the right images.
        imu: Topic of an IMU (``sensor_msgs/Imu``), whose place and noise the rig tells; empty: none.
        rig: File of the rig, such as ``rse-pf camera calibrate --stereo`` writes; empty: by ``CameraInfo``.
        depth_scale: Units of a 16-bit depth image in a metre.
        pair_within_s: Colour and depth belong together up to this difference of their time stamps.
        queue_frames: So many frames wait while another is tracked; the oldest is dropped and counted.
        map_frame: Name of the frame of the map.
        odom_frame: Name of the odometry frame of this bridge.
        camera_frame: Name of the camera's frame; empty: as in the images.
        publish_odom: Whether the transform from odometry frame to camera is published; not if something else
            publishes a parent of the camera's frame.
        cloud_every_s: Time between two clouds.
        path_poses: A path has so many poses at most; from there on, each second one is left out.
        out: Folder that the service ``save`` writes to; empty: it is refused.
        publish_as: Name of the map that the service ``publish`` makes of a map of its own; empty: refused.
        localise_in: Name of the map in which the service ``localise`` looks; empty: it is refused.

    Raises:
        UsageError: A value cannot be used.
    """

    url: str = ""
    token_file: str = ""
    enrolment: str = ""
    namespace: str = ""
    map: str = ""
    colour: str = "camera/color/image_raw"
    depth: str = "camera/aligned_depth_to_color/image_raw"
    info: str = "camera/color/camera_info"
    right: str = ""
    right_info: str = ""
    imu: str = ""
    rig: str = ""
    depth_scale: float = 1000.0
    pair_within_s: float = 0.02
    queue_frames: int = 5
    map_frame: str = "map"
    odom_frame: str = "odom"
    camera_frame: str = ""
    publish_odom: bool = True
    cloud_every_s: float = 2.0
    path_poses: int = 2000
    out: str = ""
    publish_as: str = ""
    localise_in: str = ""

    def __post_init__(self) -> None:
        for name in ("depth_scale", "pair_within_s", "cloud_every_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} = {value:g} is not above 0", hint="leave it out for the default")
        if not 1 <= self.queue_frames <= 100 or not 10 <= self.path_poses <= 100_000:
            raise UsageError(
                f"queue_frames = {self.queue_frames} or path_poses = {self.path_poses} is out of range",
                hint="1 to 100 frames, 10 to 100,000 poses",
            )
        if self.namespace and not _NAME.fullmatch(self.namespace.strip("/")):
            raise UsageError(
                f"namespace {self.namespace!r} is no name of ROS", hint="letters, digits, _ and /"
            )
        if not self.colour or not self.info:
            raise UsageError("a topic of colours and its camera_info are needed", hint="colour, info")
        if self.map and not self.partner:
            raise UsageError(
                "a live map needs a topic of depth, or of right images",
                hint="name it with depth or right, or leave map out",
            )
        if self.right and not (self.right_info or self.rig):
            raise UsageError(
                "a stereo pair needs the camera_info of its right images", hint="name right_info, or a rig"
            )
        if self.imu and not self.rig:
            raise UsageError(
                "where the IMU sits, and its noise, are not known", hint="name a file rig.json with rig"
            )

    @property
    def partner(self) -> Literal["right", "depth", ""]:
        """The role of what belongs to each colour image: its right one, or depth; empty: nothing."""
        return "right" if self.right else "depth" if self.depth else ""

    def check_rig(self, *, has_right: bool, has_imu: bool) -> None:
        """Raise UsageError if the file of the rig lacks what has a topic."""
        for topic, name, is_there in ((self.right, "right camera", has_right), (self.imu, "IMU", has_imu)):
            if topic and not is_there:
                raise UsageError(
                    f"{self.rig} has no {name}, and {topic} is one",
                    hint="add it to the file, see docs/cameras.md",
                )

    @staticmethod
    def of(values: Mapping[str, Any]) -> BridgeOptions:
        """Return the options that *values* name, such as the private parameters of a node.

        Raises:
            UsageError: A name is unknown, or a value is of another type.
        """
        kinds = {field.name: str(field.type) for field in fields(BridgeOptions)}
        unknown = sorted(set(values) - set(kinds))
        if unknown:
            raise UsageError(
                f"unknown parameter {unknown[0]!r}", hint=f"the parameters are {', '.join(kinds)}"
            )
        return BridgeOptions(**{name: _value(name, kinds[name], value) for name, value in values.items()})

    def named(self, topic: str) -> str:
        """Return the name of a topic of this robot."""
        if topic.startswith("/"):
            return topic
        prefix = self.namespace.strip("/")
        return f"/{prefix}/{topic}" if prefix else f"/{topic}"

    @property
    def own_odom_frame(self) -> str:
        """The name of the odometry frame with the robot's namespace, since frames have none of their own."""
        prefix = self.namespace.strip("/")
        return f"{prefix}/{self.odom_frame}" if prefix else self.odom_frame


def _value(name: str, kind: str, value: Any) -> Any:
    """Return a value as the type of its field; launch files give numbers and words as they look."""
    try:
        if kind == "str":
            return str(value)
        if kind == "bool":
            if isinstance(value, bool):
                return value
            word = str(value).lower()
            if word not in _TRUE + _FALSE:
                raise ValueError(word)
            return word in _TRUE
        return int(value) if kind == "int" else float(value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name} = {value!r} is no {kind}", hint="see docs/ros.md") from error
