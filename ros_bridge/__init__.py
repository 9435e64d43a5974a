"""A robot of ROS as a robot of the platform: images of topics in, poses, paths and clouds as topics out.

`options`, `incoming`, `outgoing` and `bridge` need no ROS: they take and give the bytes of messages.  The
shells `ros1_node` (rospy) and `ros2_node` (rclpy) carry those bytes.
Nothing of the platform imports this package.
"""

from ros_bridge.bridge import Bridge, Publish
from ros_bridge.incoming import IncomingFrames
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import OutgoingMessages

__all__ = ["Bridge", "BridgeOptions", "IncomingFrames", "OutgoingMessages", "Publish"]
