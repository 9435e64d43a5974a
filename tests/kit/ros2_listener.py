"""A node of ROS 2 that writes what it hears, a JSON line each; run by the Python of build/ros2.

It knows nothing of this package: the classes of its messages are those of ROS.
"""

import contextlib
import json
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage


def say(**what):
    """Write a line."""
    print(json.dumps(what), flush=True)


def nanoseconds(message):
    """Return the stamp of a message."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def pose(message):
    """Write a pose."""
    place = message.pose.pose.position
    say(
        kind="pose", stamp=nanoseconds(message), at=time.time(), frame=message.header.frame_id,
        position=[place.x, place.y, place.z], variance=message.pose.covariance[0],
    )  # fmt: skip


def odometry(message):
    """Write odometry."""
    say(
        kind="odometry",
        stamp=nanoseconds(message),
        frame=message.header.frame_id,
        child=message.child_frame_id,
    )


def moved(message):
    """Write transforms."""
    for each in message.transforms:
        say(kind="tf", frame=each.header.frame_id, child=each.child_frame_id, stamp=nanoseconds(each))


def diagnostics(message):
    """Write a status."""
    status = message.status[0]
    level = int.from_bytes(status.level, "little")
    say(kind="status", level=level, values={each.key: each.value for each in status.values})


def main():
    """Listen until killed; call the services that further arguments name."""
    rclpy.init()
    node = rclpy.create_node("listener")
    prefix, colour = sys.argv[1], sys.argv[2]
    poses = node.create_subscription(PoseWithCovarianceStamped, f"{prefix}/rse_pf/pose", pose, 100)
    node.create_subscription(
        Path, f"{prefix}/rse_pf/path", lambda each: say(kind="path", poses=len(each.poses)), 10
    )
    node.create_subscription(
        PointCloud2, f"{prefix}/rse_pf/cloud", lambda each: say(kind="cloud", points=each.width), 10
    )
    node.create_subscription(Odometry, f"{prefix}/rse_pf/odometry", odometry, 100)
    node.create_subscription(TFMessage, "/tf", moved, 100)
    kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(TFMessage, "/tf_static", moved, kept)
    node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics, 10)
    node.create_subscription(
        Image, colour, lambda each: say(kind="image", stamp=nanoseconds(each), at=time.time()),
        qos_profile_sensor_data,
    )  # fmt: skip
    for service in sys.argv[3:]:
        client = node.create_client(Trigger, service)
        client.wait_for_service(30.0)
        reply = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, reply, timeout_sec=30.0)
        name = service.rpartition("/")[2]
        say(kind=name, ok=reply.result().success, message=reply.result().message)
    until = time.monotonic() + 40.0
    while not poses.get_publisher_count() and time.monotonic() < until:  # else the first poses are missed
        time.sleep(0.05)
    say(kind="ready")
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
