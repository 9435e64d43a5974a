"""Make, encode and decode ROS messages of poses, paths, point clouds and other types.

The writer of bags and the ROS bridge both use this module, which depends on neither bags nor ROS nodes.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.bags.message_types import (
    DIAGNOSTICS,
    IMU,
    OCCUPANCY_GRID,
    ODOMETRY,
    PATH,
    POINT_CLOUD,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    load_types,
)
from rse_pf.geometry import Array, to_quaternion

__all__ = ["MessageMaker"]

_FAULTS = (
    ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, TypeError, ValueError,
    struct.error,
)  # fmt: skip
"""Exceptions that `rosbags` raises for malformed messages, in addition to its own ones."""
_FLOAT32 = 7  # number of the type FLOAT32 in ``sensor_msgs/PointField``
_UINT32 = 6  # number of the type UINT32 in ``sensor_msgs/PointField``


class MessageMaker:
    """Make messages of ROS 1 or of ROS 2, and encode and decode them: in the format of ROS 1, or as CDR."""

    def __init__(self, *, is_ros1: bool) -> None:
        """Load the message definitions of ROS 1 or ROS 2.

        Raises:
            MissingExtra: ``rosbags`` is not installed.
        """
        self.is_ros1 = is_ros1
        self.types: Any = load_types(is_ros1=is_ros1)

    def encode(self, kind: str, message: Any) -> bytes:
        """Encode a message of the type *kind*."""
        serialise = self.types.serialize_ros1 if self.is_ros1 else self.types.serialize_cdr
        return bytes(serialise(message, kind))

    def decode(self, kind: str, data: bytes | memoryview) -> Any:
        """Decode a message of the type *kind*; its arrays may be views of *data*.

        Raises:
            BrokenMessage: The bytes are not a message of this type, or there is no such type.
        """
        from rosbags.serde import SerdeError
        from rosbags.typesys import TypesysError

        parse = self.types.deserialize_ros1 if self.is_ros1 else self.types.deserialize_cdr
        try:
            return parse(data, kind)
        except (*_FAULTS, SerdeError, TypesysError) as error:
            text = " ".join(str(argument) for argument in error.args) or type(error).__name__
            raise BrokenMessage(text) from error

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message of the type *kind* with these fields, which have the names of ROS 2.

        For ROS 1, a header gets ``seq`` 0, and the matrices of a ``CameraInfo`` their capital names.
        """
        if kind == "std_msgs/msg/Header" and self.is_ros1:
            fields = {"seq": 0, **fields}
        if kind == "sensor_msgs/msg/CameraInfo" and self.is_ros1:
            fields = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
        return self.types.types[kind](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Return a ``Header`` with a time stamp in nanoseconds and the name of a frame."""
        return self.make("std_msgs/msg/Header", stamp=self._time(stamp_ns), frame_id=frame)

    def pose(self, stamp_ns: int, frame: str, T: Array) -> Any:
        """Return a ``PoseStamped`` of the pose *T* ``(4, 4)``, metres, in *frame*."""
        return self.make(POSE, header=self.header(stamp_ns, frame), pose=self._pose(T))

    def pose_with_covariance(self, stamp_ns: int, frame: str, T: Array, covariance: Array) -> Any:
        """Return a ``PoseWithCovarianceStamped``.

        Args:
            stamp_ns: Time stamp, nanoseconds.
            frame: Name of the frame in which the pose is given.
            T: ``(4, 4)``, the pose, metres.
            covariance: ``(6, 6)`` as ROS defines it: position, then rotation about the axes of *frame*.
        """
        made = self._with_covariance("Pose", "pose", self._pose(T), covariance)
        return self.make(POSE_WITH_COVARIANCE, header=self.header(stamp_ns, frame), pose=made)

    def odometry(self, stamp_ns: int, frames: tuple[str, str], T: Array, covariance: Array) -> Any:
        """Return an ``Odometry`` whose velocity is unknown: 0 with a covariance of 1e6.

        Args:
            stamp_ns: Time stamp, nanoseconds.
            frames: Names of the frame in which the pose is given, and of the frame that has this pose.
            T: ``(4, 4)``, the pose, metres.
            covariance: ``(6, 6)`` as for `pose_with_covariance`.
        """
        still = {name: self._numbers("Vector3", np.zeros(3), "xyz") for name in ("linear", "angular")}
        twist = self.make("geometry_msgs/msg/Twist", **still)
        return self.make(
            ODOMETRY,
            header=self.header(stamp_ns, frames[0]),
            child_frame_id=frames[1],
            pose=self._with_covariance("Pose", "pose", self._pose(T), covariance),
            twist=self._with_covariance("Twist", "twist", twist, np.diag(np.full(6, 1e6))),
        )

    def path_of(self, stamp_ns: int, frame: str, poses: list[Any]) -> Any:
        """Return a ``Path`` of *poses*, which `pose` made."""
        return self.make(PATH, header=self.header(stamp_ns, frame), poses=poses)

    def transform(self, stamp_ns: int, frame: str, child: str, T: Array) -> Any:
        """Return a ``TransformStamped``; *T* ``(4, 4)``, metres, is the pose of *child* in *frame*."""
        moved = self.make(
            "geometry_msgs/msg/Transform",
            translation=self._numbers("Vector3", T[:3, 3], "xyz"),
            rotation=self._numbers("Quaternion", to_quaternion(T[:3, :3]), "xyzw"),
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, frame),
            child_frame_id=child,
            transform=moved,
        )

    def transforms(self, moved: list[Any]) -> Any:
        """Return a ``TFMessage`` of transforms, which `transform` made."""
        return self.make(TF, transforms=moved)

    def imu(self, stamp_ns: int, frame: str, gyro: Array, accel: Array) -> Any:
        """Return an ``Imu`` without orientation; *gyro* ``(3,)`` is in rad/s, *accel* ``(3,)`` in m/s^2."""
        none = np.zeros(9)
        none[0] = -1.0  # by the definition of Imu, -1 means that there is no orientation
        return self.make(
            IMU,
            header=self.header(stamp_ns, frame),
            orientation=self._numbers("Quaternion", np.array([0.0, 0.0, 0.0, 1.0]), "xyzw"),
            orientation_covariance=none,
            angular_velocity=self._numbers("Vector3", gyro, "xyz"),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._numbers("Vector3", accel, "xyz"),
            linear_acceleration_covariance=np.zeros(9),
        )

    def cloud(
        self, stamp_ns: int, frame: str, points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8]
    ) -> Any:
        """Return a ``PointCloud2``: x, y, z as float32, and rgb packed as ROS tools expect it.

        Args:
            stamp_ns: Time stamp, nanoseconds.
            frame: Name of the frame of the points.
            points: ``(n, 3)``, metres.
            colours: ``(n, 3)``, RGB.
        """
        layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
        rows = np.empty(len(points), dtype=layout)
        for column, name in enumerate("xyz"):
            rows[name] = points[:, column]
        wide = colours.astype(np.uint32)
        rows["rgb"] = (wide[:, 0] << 16) | (wide[:, 1] << 8) | wide[:, 2]
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=4 * place, count=1,
                datatype=_UINT32 if name == "rgb" else _FLOAT32,
            )
            for place, name in enumerate(("x", "y", "z", "rgb"))
        ]  # fmt: skip
        return self.make(
            POINT_CLOUD,
            header=self.header(stamp_ns, frame),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=layout.itemsize,
            row_step=layout.itemsize * len(rows),
            data=np.frombuffer(rows.tobytes(), dtype=np.uint8),
            is_dense=True,
        )

    def occupancy_grid(
        self, stamp_ns: int, frame: str, cells: npt.NDArray[np.int8], T: Array, resolution_m: float
    ) -> Any:
        """Return an ``OccupancyGrid``.

        Args:
            stamp_ns: Time stamp, nanoseconds.
            frame: Name of the frame in which the pose *T* is given.
            cells: ``(h, w)``, percent of occupancy, -1 for unknown; row 0 has the lowest y.
            T: ``(4, 4)``, pose of the corner of ``cells[0, 0]``, metres.
            resolution_m: Length of a cell's edge.
        """
        info = self.make(
            "nav_msgs/msg/MapMetaData", map_load_time=self._time(stamp_ns), resolution=resolution_m,
            width=cells.shape[1], height=cells.shape[0], origin=self._pose(T),
        )  # fmt: skip
        return self.make(OCCUPANCY_GRID, header=self.header(stamp_ns, frame), info=info, data=cells.ravel())

    def diagnostics(self, stamp_ns: int, name: str, level: int, text: str, values: dict[str, str]) -> Any:
        """Return a ``DiagnosticArray`` with one status; *level* is 0 for OK, 1 for a warning, 2 for error."""
        pairs = [
            self.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()
        ]
        status = self.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level, name=name, message=text, hardware_id="", values=pairs,
        )  # fmt: skip
        return self.make(DIAGNOSTICS, header=self.header(stamp_ns, ""), status=[status])

    def _time(self, stamp_ns: int) -> Any:
        seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
        return self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_ns)

    def _with_covariance(self, kind: str, name: str, value: Any, covariance: Array) -> Any:
        numbers = np.ascontiguousarray(covariance, dtype=np.float64).ravel()
        return self.make(f"geometry_msgs/msg/{kind}WithCovariance", **{name: value, "covariance": numbers})

    def _pose(self, T: Array) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self._numbers("Point", T[:3, 3], "xyz"),
            orientation=self._numbers("Quaternion", to_quaternion(T[:3, :3]), "xyzw"),
        )

    def _numbers(self, kind: str, values: Array, names: str) -> Any:
        fields = {name: float(value) for name, value in zip(names, values, strict=True)}
        return self.make(f"geometry_msgs/msg/{kind}", **fields)
