"""A node of ROS 1 that writes what it hears, a JSON line each; run by the Python of Debian's rospy.

It knows nothing of this package: the classes of its messages are Debian's own.
"""

import json
import sys
import threading
import time

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import Image, PointCloud2
from tf2_msgs.msg import TFMessage

_LOCK = threading.Lock()


def say(**what):
    """Write a line."""
    with _LOCK:  # each topic has a thread
        print(json.dumps(what), flush=True)


def pose(message):
    """Write a pose."""
    place = message.pose.pose.position
    say(
        kind="pose", stamp=message.header.stamp.to_nsec(), at=time.time(), frame=message.header.frame_id,
        position=[place.x, place.y, place.z], variance=message.pose.covariance[0],
    )  # fmt: skip


def moved(message):
    """Write transforms."""
    for each in message.transforms:
        say(
            kind="tf",
            frame=each.header.frame_id,
            child=each.child_frame_id,
            stamp=each.header.stamp.to_nsec(),
        )


def diagnostics(message):
    """Write a status."""
    status = message.status[0]
    say(kind="status", level=status.level, values={each.key: each.value for each in status.values})


def main():
    """Listen until killed."""
    rospy.init_node("listener", anonymous=True)
    colour = sys.argv[1]
    rospy.Subscriber("/rse_pf/pose", PoseWithCovarianceStamped, pose, tcp_nodelay=True)
    rospy.Subscriber("/rse_pf/path", Path, lambda each: say(kind="path", poses=len(each.poses)))
    rospy.Subscriber("/rse_pf/cloud", PointCloud2, lambda each: say(kind="cloud", points=each.width))
    rospy.Subscriber("/tf", TFMessage, moved)
    rospy.Subscriber("/diagnostics", DiagnosticArray, diagnostics)
    if colour:
        rospy.Subscriber(
            colour, Image, lambda each: say(kind="image", stamp=each.header.stamp.to_nsec(), at=time.time()),
            tcp_nodelay=True,
        )  # fmt: skip
    say(kind="ready")
    rospy.spin()


if __name__ == "__main__":
    main()
