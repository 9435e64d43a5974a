"""Play a bag into the topics of ROS 2 at its own pace, without the ros2 command.

Needs a ROS 2 (rclpy) and rosbags: pip install 'rse-pf[ros2]' installs both.  Images go out best effort, as
camera drivers send them; everything else is reliable.
"""

import argparse
import importlib
import sys
import time
from pathlib import Path

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("bag", type=Path, help="folder of a ROS 2 bag")
parser.add_argument("--rate", type=float, default=1.0, help="times the speed of the bag (default: 1)")
parser.add_argument("--wait", nargs="*", default=(), help="begin when these topics have a subscriber")
parser.add_argument("--wait-s", type=float, default=30.0, help="wait for them so long (default: 30)")


def main(args: argparse.Namespace) -> int:
    if not args.rate > 0:
        print("--rate has to be above 0", file=sys.stderr)
        return 2
    import rclpy  # here, so that --help needs no ROS
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rclpy.init()
    node = rclpy.create_node("play_bag")
    with AnyReader([args.bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        publishers = {}
        for connection in bag.connections:
            package, _, name = connection.msgtype.partition("/msg/")
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            is_image = name in ("Image", "CompressedImage", "CameraInfo", "Imu")
            reliability = ReliabilityPolicy.BEST_EFFORT if is_image else ReliabilityPolicy.RELIABLE
            publishers[connection.topic] = node.create_publisher(
                kind, connection.topic, QoSProfile(depth=10, reliability=reliability)
            )
        until_s = time.monotonic() + args.wait_s
        while silent := [topic for topic in args.wait if not publishers[topic].get_subscription_count()]:
            if time.monotonic() > until_s:
                print(f"nobody takes {', '.join(silent)}", file=sys.stderr)
                return 1
            rclpy.spin_once(node, timeout_sec=0.05)
        began_s, first_ns, sent = time.monotonic(), None, 0
        for connection, log_ns, data in bag.messages():
            first_ns = log_ns if first_ns is None else first_ns
            due_s = began_s + (log_ns - first_ns) / 1e9 / args.rate
            time.sleep(max(0.0, due_s - time.monotonic()))
            publishers[connection.topic].publish(bytes(data))
            sent += 1
    print(f"{sent} messages played")
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main(parser.parse_args()))
