"""The bridge that makes a ROS robot a robot of the platform.

The bridge receives the images of topics and publishes poses, paths, transforms and clouds as topics.  The
modules `options`, `incoming`, `outgoing` and `bridge` need no ROS: they receive and return the bytes of
messages. The shells `ros1_node` (rospy) and `ros2_node` (rclpy) transport these bytes.  No package of the
platform imports this one.
"""

from ros_bridge.bridge import Bridge, Publish
from ros_bridge.incoming import IncomingFrames
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import OutgoingMessages

__all__ = ["Bridge", "BridgeOptions", "IncomingFrames", "OutgoingMessages", "Publish"]
