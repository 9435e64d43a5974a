"""Be the camera of a robot of ROS 2: publish rendered images with depth, and print the poses that come back.

Needs a ROS 2 (rclpy); pip install 'rse-pf[ros2]' installs one.  Its topics are those of a RealSense driver.
"""

import argparse
import sys
import time

import numpy as np

from client_sdk.simulator import render_frames

TOPICS = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw", "/camera/color/camera_info"
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--frames", type=int, default=80, help="images to publish (default: 80)")
parser.add_argument("--rate", type=float, default=5.0, help="images per second (default: 5)")


def main(args: argparse.Namespace) -> None:
    import rclpy  # here, so that the example can be read without ROS
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import CameraInfo, Image

    def heard(message):
        at = message.pose.pose.position
        print(f"pose in {message.header.frame_id}: x {at.x:.3f}  y {at.y:.3f}  z {at.z:.3f} m", flush=True)

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C ends the program
    node = rclpy.create_node("camera")
    colours, depths = (node.create_publisher(Image, each, qos_profile_sensor_data) for each in TOPICS[:2])
    infos = node.create_publisher(CameraInfo, TOPICS[2], qos_profile_sensor_data)
    node.create_subscription(PoseWithCovarianceStamped, "/rse_pf/pose", heard, 10)
    print("waiting for a bridge that takes", TOPICS[0], flush=True)
    while not (colours.get_subscription_count() and infos.get_subscription_count()):
        time.sleep(0.1)
    time.sleep(1.0)  # the bridge finds the depth, too
    for number, frame in enumerate(render_frames(0, 1, args.frames, seed=0), 1):
        next_s = time.monotonic() + (1.0 / args.rate if number < args.frames else 4.0)  # for late poses
        now, camera = node.get_clock().now().to_msg(), frame.camera
        info = CameraInfo(width=camera.width, height=camera.height, distortion_model="plumb_bob")
        info.k, info.p = camera.matrix.ravel(), np.eye(3, 4).ravel()
        info.header.stamp, info.header.frame_id = now, "camera_color_optical_frame"
        infos.publish(info)
        millimetres = np.round(1000 * frame.depth_m).astype(np.uint16)
        for topic, pixels, encoding in ((colours, frame.rgb, "rgb8"), (depths, millimetres, "16UC1")):
            image = Image(header=info.header, width=camera.width, height=camera.height, encoding=encoding)
            image.step, image.data = pixels.strides[0], pixels.tobytes()
            topic.publish(image)
        while time.monotonic() < next_s:
            rclpy.spin_once(node, timeout_sec=max(0.0, next_s - time.monotonic()))


if __name__ == "__main__":
    try:
        main(parser.parse_args())
    except KeyboardInterrupt:
        sys.exit(130)
    except ModuleNotFoundError as error:
        sys.exit(f"{error.name} is not installed: see docs/ros.md, or source the setup.bash of your ROS 2")
