"""Start the bridge in ROS 2: ros2 launch rse_pf_bridge/launch/bridge_launch.py url:=... token_file:=...

This file was never run, because no ``ros2 launch`` was available.
"""

import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "url": "",
    "token_file": "",
    "enrolment": "",
    "namespace": "",
    "map": "",
    "colour": "camera/color/image_raw",
    "depth": "camera/aligned_depth_to_color/image_raw",
    "info": "camera/color/camera_info",
    "right": "",
    "right_info": "",
    "imu": "",
    "rig": "",
    "queue_frames": "5",
    "pair_within_s": "0.02",
    "odometry": "",
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "publish_odom": "true",
    "planar": "false",
    "transform_tolerance_s": "0.5",
    "max_correction_m_s": "0.0",
    "floor_plan_every_s": "0.0",
    "out": "",
}


def generate_launch_description() -> LaunchDescription:
    """Return the launch of the bridge: its arguments, and the process of the Python that has rse-pf[ros]."""
    options = [
        word for name in ARGUMENTS for word in (f"--{name.replace('_', '-')}", LaunchConfiguration(name))
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("python", default_value=sys.executable),
            *(DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            ExecuteProcess(
                cmd=[
                    LaunchConfiguration("python"),
                    "-m",
                    "ros_bridge",
                    "ros2",
                    *options,
                    "--ros-args",
                    "-p",
                    ["use_sim_time:=", LaunchConfiguration("use_sim_time")],
                ],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
        ]
    )
