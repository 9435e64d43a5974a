"""Drive a robot of ROS 2 to the goals of /goal_pose by the poses and the floor plan of a bridge.

A small stand-in for Nav2: it reads /tf, /odom, /rse_pf/floor_plan and /rse_pf/status, and publishes /cmd_vel.
Needs a ROS 2 (rclpy); pip install 'rse-pf[ros2]' installs one.
"""

import argparse
import math
import sys

import numpy as np
from drive_to_goals import Navigator, yaw_of

from rse_pf.geometry import Array
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

parser = argparse.ArgumentParser(description=__doc__)
REPLAN_S = 2.0  # time from one path to the next, in seconds of the clock of ROS


class Driver:
    """Drives to one goal at a time; the robot stands still without one."""

    def __init__(self) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped, TwistStamped
        from nav_msgs.msg import OccupancyGrid as GridMessage
        from nav_msgs.msg import Odometry
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Bool, String
        from tf2_msgs.msg import TFMessage

        self.node = rclpy.create_node("drive_to_goals")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._commands = self.node.create_publisher(TwistStamped, "/cmd_vel", 10)
        self._reached = self.node.create_publisher(Bool, "/goal_reached", 10)
        self.node.create_subscription(PoseStamped, "/goal_pose", self._on_goal, latched)
        self.node.create_subscription(GridMessage, "/rse_pf/floor_plan", self._on_plan, latched)
        self.node.create_subscription(String, "/rse_pf/status", self._on_status, latched)
        self.node.create_subscription(TFMessage, "/tf", self._on_transforms, 50)
        self.node.create_subscription(Odometry, "/odom", self._on_odometry, 1)
        self._plan: OccupancyGrid | None = None
        self._T_map_odom: Array | None = None
        self._status = "lost"
        self._navigator: Navigator | None = None
        self._planned_s = -math.inf
        self._said = ""

    def _on_goal(self, message) -> None:
        at, turned = message.pose.position, message.pose.orientation
        self._navigator = Navigator(np.array([at.x, at.y, 2.0 * math.atan2(turned.z, turned.w)]))
        self._planned_s = -math.inf

    def _on_plan(self, message) -> None:
        info = message.info
        values = np.array(message.data, dtype=np.int8).reshape(info.height, info.width)
        self._plan = OccupancyGrid(
            cells=np.select((values < 0, values > 50), (UNKNOWN, OCCUPIED), FREE).astype(np.uint8),
            origin_m=(info.origin.position.x, info.origin.position.y),
            resolution_m=info.resolution,
            floor_m=info.origin.position.z,
            T_grid_world=np.eye(4),
            up_source="--up",
        )

    def _on_status(self, message) -> None:
        self._status = message.data

    def _on_transforms(self, message) -> None:
        for each in message.transforms:
            if each.header.frame_id == "map" and each.child_frame_id == "odom":
                moved, turned = each.transform.translation, each.transform.rotation
                self._T_map_odom = pose_of(moved, turned)

    def _on_odometry(self, message) -> None:
        from geometry_msgs.msg import TwistStamped
        from std_msgs.msg import Bool

        navigator, plan = self._navigator, self._plan
        if navigator is None:
            self._say("waiting for a goal on /goal_pose")
            return
        if plan is None or self._T_map_odom is None:
            self._say("waiting for /rse_pf/floor_plan, and for map -> odom on /tf")
            return
        pose, stamp = message.pose.pose, message.header.stamp
        T_map_base = self._T_map_odom @ pose_of(pose.position, pose.orientation)
        x_m, y_m = T_map_base[:2, 3].tolist()
        now_s = stamp.sec + 1e-9 * stamp.nanosec
        if now_s >= self._planned_s + REPLAN_S:
            self._planned_s = now_s
            navigator.replan(plan, x_m, y_m)
        state = "lost" if self._status == "lost" else "no path" if navigator.path is None else "on the way"
        self._say(f"{state} to x {navigator.goal[0]:.2f} m, y {navigator.goal[1]:.2f} m")
        command = navigator.command(x_m, y_m, yaw_of(T_map_base), self._status)
        stamped = TwistStamped(header=message.header)
        stamped.twist.linear.x, stamped.twist.angular.z = command or (0.0, 0.0)
        self._commands.publish(stamped)
        if command is None:
            self._navigator = None
            self._say("the goal is reached")
            self._reached.publish(Bool(data=True))

    def _say(self, sentence: str) -> None:
        """Print a sentence if it is another one than before."""
        if sentence != self._said:
            self._said = sentence
            print(sentence, flush=True)


def pose_of(position, orientation) -> Array:
    """Return the pose ``(4, 4)`` of a robot in a plane."""
    yaw_rad = 2.0 * math.atan2(orientation.z, orientation.w)
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]]
    pose[:2, 3] = position.x, position.y
    return pose


def main() -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C ends the program
    rclpy.spin(Driver().node)


if __name__ == "__main__":
    parser.parse_args()
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
    except ModuleNotFoundError as error:
        sys.exit(f"{error.name} is not installed: see docs/ros.md, or source the setup.bash of your ROS 2")
