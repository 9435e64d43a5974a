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
parser.add_argument("--wait", nargs="*", default=(), help="topics that must have a subscriber first")
parser.add_argument("--wait-s", type=float, default=30.0, help="wait for them so long (default: 30)")
parser.add_argument("--delay-s", type=float, default=2.0, help="then let all find each other (default: 2)")


def main(args: argparse.Namespace) -> int:
    if not args.rate > 0:
        print("--rate has to be above 0", file=sys.stderr)
        return 2
    import rclpy  # here, so that --help needs no ROS
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C ends the program
    node = rclpy.create_node("play_bag")
    with AnyReader([args.bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        publishers = {}
        for topic, kind in {each.topic: each.msgtype for each in bag.connections}.items():
            package, _, name = kind.partition("/msg/")
            is_sensor = name in ("Image", "CompressedImage", "CameraInfo", "Imu")
            best = ReliabilityPolicy.BEST_EFFORT if is_sensor else ReliabilityPolicy.RELIABLE
            message = getattr(importlib.import_module(f"{package}.msg"), name)
            publishers[topic] = node.create_publisher(message, topic, QoSProfile(depth=10, reliability=best))
        until_s = time.monotonic() + args.wait_s
        while silent := [topic for topic in args.wait if not publishers[topic].get_subscription_count()]:
            if time.monotonic() > until_s:
                print(f"nobody takes {', '.join(silent)}", file=sys.stderr)
                return 1
            time.sleep(0.05)
        began_s, first_ns, sent = time.monotonic() + args.delay_s, None, 0
        for connection, log_ns, data in bag.messages():
            first_ns = log_ns if first_ns is None else first_ns
            time.sleep(max(0.0, began_s + (log_ns - first_ns) / 1e9 / args.rate - time.monotonic()))
            publishers[connection.topic].publish(bytes(data))
            sent += 1
    print(f"{sent} messages played")
    return 0


if __name__ == "__main__":
    sys.exit(main(parser.parse_args()))
