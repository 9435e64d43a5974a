"""The bridge that makes a ROS robot a robot of the platform.

The bridge receives the images of topics and publishes poses, paths, transforms and clouds as topics.  Only
its shells need ROS, `ros1_node` (rospy) and `ros2_node` (rclpy), which transport the bytes of messages; all
other modules receive and return these bytes.  No package of the platform imports this one.
"""

from ros_bridge.bridge import Bridge, Publish
from ros_bridge.incoming import IncomingFrames
from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import OutgoingMessages
from ros_bridge.robot_frames import RobotFrames

__all__ = ["Bridge", "BridgeOptions", "IncomingFrames", "OutgoingMessages", "Publish", "RobotFrames"]
