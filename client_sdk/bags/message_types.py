"""Definitions of the ROS messages that bags are read and written with.

The definitions are the same in every distribution of ROS.  Definitions inside a bag are not used, so that a
wrong one does no harm.  ROS 1 differs from ROS 2 in two definitions: a header has a sequence number, and the
matrices of a ``CameraInfo`` have capital names.
"""

from __future__ import annotations

import functools
from typing import Any

from rse_pf.errors import MissingExtra

__all__ = [
    "CAMERA_INFO",
    "COMPRESSED_IMAGE",
    "DIAGNOSTICS",
    "FLOAT",
    "IMAGE",
    "IMU",
    "OCCUPANCY_GRID",
    "ODOMETRY",
    "PATH",
    "POINT_CLOUD",
    "POSE",
    "POSE_WITH_COVARIANCE",
    "STRING",
    "TF",
    "TF_OF_ROS1",
    "TRANSFORM",
    "load_types",
]

# Names of ROS message types, as ROS 2 spells them.
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
TF = "tf2_msgs/msg/TFMessage"
TF_OF_ROS1 = "tf/msg/tfMessage"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
ODOMETRY = "nav_msgs/msg/Odometry"
PATH = "nav_msgs/msg/Path"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
FLOAT = "std_msgs/msg/Float32"
STRING = "std_msgs/msg/String"
TRANSFORM = "geometry_msgs/msg/Transform"

# Definition of ``std_msgs/Header`` in ROS 2.
_HEADER = "time stamp\nstring frame_id"
# Definitions that ROS 1 and ROS 2 share, by name of the type.
_COMMON = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    FLOAT: "float32 data",
    STRING: "string data",
    TRANSFORM: "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/msg/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    POSE: "std_msgs/Header header\ngeometry_msgs/Pose pose",
    POSE_WITH_COVARIANCE: "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    ODOMETRY: (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    PATH: "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses",
    "nav_msgs/msg/MapMetaData": (
        "time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin"
    ),
    OCCUPANCY_GRID: "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data",
    TF: "geometry_msgs/TransformStamped[] transforms",
    TF_OF_ROS1: "geometry_msgs/TransformStamped[] transforms",
    IMAGE: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data"
    ),
    COMPRESSED_IMAGE: "std_msgs/Header header\nstring format\nuint8[] data",
    IMU: (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance"
    ),
    "sensor_msgs/msg/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/msg/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
        "uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count"
    ),
    POINT_CLOUD: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense"
    ),
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value",
    "diagnostic_msgs/msg/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n"
        "string hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    DIAGNOSTICS: "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
}
# Definition of ``sensor_msgs/CameraInfo``; ROS 1 and ROS 2 differ in the names of its matrices.
_CAMERA = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] {d}\n"
    "float64[9] {k}\nfloat64[9] {r}\nfloat64[12] {p}\nuint32 binning_x\nuint32 binning_y\n"
    "sensor_msgs/RegionOfInterest roi"
)


@functools.cache
def load_types(*, is_ros1: bool) -> Any:
    """Return a type store of `rosbags` with these definitions, for ROS 1 or ROS 2.

    Raises:
        MissingExtra: ``rosbags`` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtra("rosbags", "bags") from error
    names = {"d": "D", "k": "K", "r": "R", "p": "P"} if is_ros1 else {name: name for name in "dkrp"}
    texts = {
        **_COMMON,
        "std_msgs/msg/Header": f"uint32 seq\n{_HEADER}" if is_ros1 else _HEADER,
        CAMERA_INFO: _CAMERA.format(**names),
    }
    store = get_typestore(Stores.EMPTY)
    definitions: dict[str, Any] = {}
    for name, text in texts.items():
        definitions.update(get_types_from_msg(text, name))
    store.register(definitions)
    return store
