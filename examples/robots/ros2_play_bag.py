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
parser.add_argument("--wait", nargs="*", default=(), help="TOPIC or TOPIC=SUBSCRIBERS to wait for, 30 s")
parser.add_argument("--delay-s", type=float, default=2.0, help="pause before and after (default: 2)")


def main(args: argparse.Namespace) -> None:
    if not args.rate > 0:
        parser.error("--rate has to be above 0")
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
        until_s = time.monotonic() + 30.0
        wanted = {topic: int(count or 1) for topic, _, count in (each.partition("=") for each in args.wait)}
        while silent := [each for each, n in wanted.items() if publishers[each].get_subscription_count() < n]:
            if time.monotonic() > until_s:
                sys.exit(f"nobody takes {', '.join(silent)}")
            time.sleep(0.05)
        began_s, first_ns, sent = time.monotonic() + args.delay_s, None, 0
        for connection, log_ns, data in bag.messages():
            first_ns = log_ns if first_ns is None else first_ns
            time.sleep(max(0.0, began_s + (log_ns - first_ns) / 1e9 / args.rate - time.monotonic()))
            publishers[connection.topic].publish(bytes(data))
            sent += 1
        time.sleep(args.delay_s)  # what was published last leaves with the program else
    print(f"{sent} messages played")


if __name__ == "__main__":
    try:
        main(parser.parse_args())
    except KeyboardInterrupt:
        sys.exit(130)
