"""The options of a bridge, from a command line, the parameters of a launch file, or a program."""

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
    "namespace": "name of this robot, put before the names of its topics and frames",
    "map": "live map that the robot shares with other robots (default: a map of its own)",
    "colour": "topic of the colour images",
    "depth": "topic of the depth images registered to the colour images; empty: none",
    "info": "topic of the camera_info of the colour images",
    "right": "topic of the right images of a stereo pair, instead of depth; empty: none",
    "right_info": "topic of the camera_info of the right images",
    "imu": "topic of an IMU; needs rig",
    "rig": "file of the rig, rig.json; empty: calibration by both camera_info",
    "depth_scale": "units of a 16-bit depth image in a metre",
    "pair_within_s": "largest difference in time of a colour image and its depth or right image, in seconds",
    "queue_frames": "largest number of frames that wait while another is tracked",
    "odometry": "topic of the odometry of the wheels; empty: that of /tf, if there is one",
    "map_frame": "name of the frame of the map",
    "odom_frame": "name of the odometry frame",
    "base_frame": "name of the robot's frame; empty: the camera's frame",
    "camera_frame": "name of the camera's frame (default: as in the images)",
    "publish_odom": "false: never publish the transform from odometry frame to robot",
    "planar": "whether the robot stays in the plane z = 0 of the map, without roll and pitch",
    "transform_tolerance_s": "how far in the future map to odometry frame is stamped, in seconds",
    "max_correction_m_s": "largest speed at which map to odometry frame is corrected, in m/s; 0: at once",
    "floor_plan_every_s": "time between two floor plans, in seconds; 0: none",
    "cloud_every_s": "time between two clouds, in seconds",
    "path_poses": "largest number of poses of a path",
    "out": "folder that the service save writes to",
    "publish_as": "name under which the service publish stores the robot's own map",
    "localise_in": "name of the stored map in which the service localise finds the pose",
}
"""The help text of each option, for the command line and for the description of a ROS 2 parameter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeOptions:
    """The options of a bridge: its platform, topics, coordinate frames and maps.

    Attributes:
        url: Address of the platform, ``ws://HOST:PORT/ws``.
        token_file: File that holds the robot's token; it is read again for each connection.
        enrolment: File of ``rse-pf robot enrol --out``, instead of ``url`` and ``token_file``.
        namespace: Name of this robot, such as ``robot1``, put before the names of its topics and frames, but
            not before ``map_frame``.
        map: Name of the live map that the robot shares with other robots; empty: the robot has a map of its
            own.
        colour: Topic of the colour images: ``Image``, or ``CompressedImage`` if its name ends with
            ``compressed``.
        depth: Topic of the depth images that are registered to the colour images; compressed if its name ends
            with ``compressedDepth``.  Empty: no depth.
        info: Topic of the ``CameraInfo`` of the colour images.
        right: Topic of the right images of a stereo pair, whose left images are the colour images; depth
            images are not used then.  Empty: no pair.
        right_info: Topic of the ``CameraInfo`` of the right images.
        imu: Topic of an IMU (``sensor_msgs/Imu``), whose pose and noise ``rig`` states; empty: no IMU.
        rig: File of the rig, as ``rse-pf camera calibrate --stereo`` writes it; empty: the calibration of a
            pair is that of both ``CameraInfo`` topics.
        depth_scale: Units of a 16-bit depth image in a metre.
        pair_within_s: Largest difference (s) of the time stamps of a colour image and its depth or right
            image.
        queue_frames: Largest number of frames that wait while another is tracked; above it, the oldest frame
            is dropped and counted.
        odometry: Topic of the odometry of the wheels (``nav_msgs/Odometry``).  Empty: the transform from
            odometry frame to robot on ``/tf``, if another node publishes it.
        map_frame: Name of the coordinate frame of the map; it never gets the namespace.
        odom_frame: Name of the odometry frame; the namespace is put before it, unless it begins with ``/``.
        base_frame: Name of the robot's frame; the namespace is put before it, unless it begins with ``/``.
            Empty: the camera's frame.
        camera_frame: Name of the camera's frame; empty: the name in the messages of the images.
        publish_odom: Whether the transform from odometry frame to robot may be published.  It is not if
            another node publishes it, or if ``odometry`` is set.
        planar: Whether the robot stays in the plane z = 0 of the map, without roll and pitch.
        transform_tolerance_s: Time (s) by which the transform from map to odometry frame is stamped in the
            future.
        max_correction_m_s: Largest speed (m/s) at which a correction moves the robot in the tree of frames; a
            rotation by 1 rad counts as 1 m.  0: corrections are applied at once.
        floor_plan_every_s: Time between two floor plans, in seconds; 0: none.  That of a live map is also
            published at once after a correction.
        cloud_every_s: Time between two clouds, in seconds.
        path_poses: Largest number of poses of a path; above it, every second pose is left out.
        out: Folder that the service ``save`` writes to; empty: the service fails.
        publish_as: Name under which the service ``publish`` stores the robot's own map; empty: the service
            fails.
        localise_in: Name of the stored map in which the service ``localise`` finds the pose; empty: the
            service fails.

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
    odometry: str = ""
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    camera_frame: str = ""
    publish_odom: bool = True
    planar: bool = False
    transform_tolerance_s: float = 0.5
    max_correction_m_s: float = 0.0
    floor_plan_every_s: float = 0.0
    cloud_every_s: float = 2.0
    path_poses: int = 2000
    out: str = ""
    publish_as: str = ""
    localise_in: str = ""

    def __post_init__(self) -> None:
        for name in ("depth_scale", "pair_within_s", "cloud_every_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(
                    f"{name} = {value:g} is not a finite number above 0", hint="leave it out for the default"
                )
        for name in ("transform_tolerance_s", "max_correction_m_s", "floor_plan_every_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(
                    f"{name} = {value:g} is not a finite number of 0 or above",
                    hint="leave it out for the default",
                )
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
        """The role of the second image of a frame: "right" for a stereo pair, "depth", or empty for none."""
        return "right" if self.right else "depth" if self.depth else ""

    def check_rig(self, *, has_right: bool, has_imu: bool) -> None:
        """Raise UsageError if the file of the rig lacks the right camera or the IMU whose topic is set."""
        for topic, name, is_there in ((self.right, "right camera", has_right), (self.imu, "IMU", has_imu)):
            if topic and not is_there:
                raise UsageError(
                    f"{self.rig} has no {name}, and {topic} is one",
                    hint="add it to the file, see docs/cameras.md",
                )

    @staticmethod
    def of(values: Mapping[str, Any]) -> BridgeOptions:
        """Return the options with *values* by name, such as the private parameters of a node.

        Raises:
            UsageError: A name is unknown, or a value cannot be converted to the type of its option.
        """
        kinds = {field.name: str(field.type) for field in fields(BridgeOptions)}
        unknown = sorted(set(values) - set(kinds))
        if unknown:
            raise UsageError(
                f"unknown parameter {unknown[0]!r}", hint=f"the parameters are {', '.join(kinds)}"
            )
        return BridgeOptions(**{name: _value(name, kinds[name], value) for name, value in values.items()})

    def named(self, topic: str) -> str:
        """Return the absolute name of *topic*: the namespace is put before a name without a leading slash."""
        if topic.startswith("/"):
            return topic
        prefix = self.namespace.strip("/")
        return f"/{prefix}/{topic}" if prefix else f"/{topic}"

    @property
    def own_odom_frame(self) -> str:
        """The name of the odometry frame with the robot's namespace before it, see `named_frame`."""
        return self.named_frame(self.odom_frame)

    @property
    def own_base_frame(self) -> str:
        """The name of the robot's frame with its namespace before it; empty for the camera's frame."""
        return self.named_frame(self.base_frame) if self.base_frame else ""

    def named_frame(self, frame: str) -> str:
        """Return the name of *frame*: the namespace is put before a name without a leading slash.

        The namespace is part of the name because ROS adds namespaces to names of topics, but not to names of
        frames.
        """
        prefix = self.namespace.strip("/")
        return frame.strip("/") if frame.startswith("/") or not prefix else f"{prefix}/{frame}"


def _value(name: str, kind: str, value: Any) -> Any:
    """Return *value* converted to *kind*, the type of the option *name*; launch files may use another type.

    Raises:
        UsageError: The value cannot be converted.
    """
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
