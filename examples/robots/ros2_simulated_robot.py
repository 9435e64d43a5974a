"""Be a simulated robot on wheels of ROS 2: follow /cmd_vel, publish camera, wheels and clock; judge goals.

The robot drives through a rendered building.  First it is driven along a tour, so that a map is made; then it
sends goals to /goal_pose, waits for /goal_reached, and prints how far from each goal the robot truly is.
Goals are places in the map, as if they were clicked there: where the map lies in the building is found by the
path of the tour.  Time is simulated, and waits for poses and commands.  Needs a ROS 2 (rclpy);
pip install 'rse-pf[ros2]' installs one.
"""

import argparse
import math
import sys
import time

import numpy as np

from client_sdk.simulator.base import (
    BASE_CAMERA,
    FRAME_STEPS,
    STEP_S,
    T_BASE_CAMERA,
    DifferentialBase,
    SlippingWheels,
    drive_route,
)
from client_sdk.simulator.building import BUILDINGS, make_building
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from rse_pf.geometry import Array, inverse, planar_pose

COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"
CAMERA_FRAME = "camera_color_optical_frame"
START_S = 10.0  # time of the first image: a time of 0 means in ROS that there is no clock yet
ANSWER_WAIT_S = 1.0  # longest wait for a pose and a command, in real seconds
COMMAND_S = 0.5  # a command with an older stamp stops the robot, as the drivers of real bases do
PUT_DOWN_S = 3.0  # simulated time for which a robot that was carried stands before it gets a goal
LEAST_TOUR_M = 5.0  # shortest tour whose path tells how the map is turned
GOAL_S = 150.0  # longest simulated time for a goal
REACHED_M, REACHED_DEG = 0.15, 10.0  # largest true errors of position and direction at a goal that is reached
WRONG_M = 0.2  # a pose by the camera with a larger error is counted as wrong

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--building", choices=BUILDINGS, default="rooms", help="default: rooms")
parser.add_argument(
    "--tour", type=float, default=60.0, help="length of the first tour in metres (default: 60)"
)
parser.add_argument("--goals", type=int, default=5, help="random goals after the tour (default: 5)")
parser.add_argument(
    "--carried", type=int, nargs="*", default=(), help="goals before which the robot is carried away"
)
parser.add_argument("--times", action="store_true", help="print the simulated time once a second")
parser.add_argument("--seed", type=int, default=0, help="chooses tour, goals and noise (default: 0)")


class Robot:
    """The robot, its sensors and its clock as a node of ROS 2."""

    def __init__(self, args: argparse.Namespace) -> None:
        import rclpy
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped
        from nav_msgs.msg import Odometry, Path
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from rosgraph_msgs.msg import Clock
        from sensor_msgs.msg import CameraInfo, Image
        from std_msgs.msg import Bool, String
        from tf2_msgs.msg import TFMessage

        self._spin_once, self.node = rclpy.spin_once, rclpy.create_node("simulated_robot")
        publisher, subscribe = self.node.create_publisher, self.node.create_subscription
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._clock, self._odometry = publisher(Clock, "/clock", 10), publisher(Odometry, "/odom", 50)
        self._transforms = publisher(TFMessage, "/tf", 50)
        self._statics = publisher(TFMessage, "/tf_static", latched)
        self._images = {topic: publisher(Image, topic, qos_profile_sensor_data) for topic in (COLOUR, DEPTH)}
        self._infos = publisher(CameraInfo, INFO, qos_profile_sensor_data)
        self._goals = publisher(PoseStamped, "/goal_pose", latched)
        subscribe(TwistStamped, "/cmd_vel", self._on_command, 10)
        subscribe(Bool, "/goal_reached", self._on_goal_reached, 10)
        subscribe(String, "/rse_pf/status", self._on_status, latched)
        subscribe(PoseWithCovarianceStamped, "/rse_pf/pose", self._on_pose, 10)
        subscribe(Path, "/rse_pf/path", self._on_path, 10)

        self._building = make_building(args.building, 0)
        self._renderer = Renderer(self._building.world, BASE_CAMERA)
        self._tour = drive_route(self._building, self._building.route(args.seed, max(args.tour, 10.0)))
        self.base = DifferentialBase(self._building, *self._start_of_tour())
        self._T_building_map = self.base.T_building_base  # the map begins at the robot
        self._wheels, self._rng = SlippingWheels(args.seed), np.random.default_rng(args.seed)
        self._T_odom_base: Array = np.eye(4)
        self.time_s = START_S
        self._command, self._commanded_s = (0.0, 0.0), -math.inf
        self._status = "lost"
        self._truths: dict[int, Array] = {}
        self._path: dict[int, tuple[float, float]] = {}
        self._newest_pose_ns = 0
        self._prints_times = args.times
        self._has_goal = False
        self.says_reached = False
        self.wrong_poses = 0
        self._statics.publish(
            TFMessage(transforms=[self._transform("base_link", CAMERA_FRAME, T_BASE_CAMERA)])
        )

    def _start_of_tour(self) -> tuple[float, float, float]:
        start = self._tour.T_building_base[0]
        return float(start[0, 3]), float(start[1, 3]), math.atan2(start[1, 0], start[0, 0])

    def wait_for_bridge(self) -> None:
        """Wait until images, depth and calibration have a subscriber; the clock stands still."""
        print(f"waiting for a bridge that takes {COLOUR}", flush=True)
        waited = (*self._images.values(), self._infos, self._odometry)
        while not all(each.get_subscription_count() for each in waited):
            self._publish_clock()
            self._spin_once(self.node, timeout_sec=0.1)
        print("a bridge takes the images: the tour begins", flush=True)

    def drive_tour(self, length_m: float) -> None:
        """Drive a length of the tour, as somebody with a joystick would."""
        self._observe()
        way_m = 0.0
        for wheels_m, T_building_base in zip(
            self._tour.wheels_m, self._tour.T_building_base[1:], strict=True
        ):
            if way_m > length_m:
                break
            way_m += abs(float(wheels_m.mean()))
            self.base.x_m, self.base.y_m = T_building_base[:2, 3].tolist()
            self.base.yaw_rad = math.atan2(T_building_base[1, 0], T_building_base[0, 0])
            self._advance(*wheels_m.tolist())

    def find_map(self) -> None:
        """Find where the map lies in the building by the newest path, which has all corrections."""
        stamps = sorted(self._path.keys() & self._truths.keys())
        if len(stamps) < 2:
            sys.exit("no path came on /rse_pf/path: read /diagnostics of the bridge, which says why")
        in_map = np.array([self._path[each] for each in stamps])
        in_building = np.array([self._truths[each][:2, 3] for each in stamps])
        to_map, to_building = in_map - in_map.mean(0), in_building - in_building.mean(0)
        yaw_rad = math.atan2(
            np.sum(to_map[:, 0] * to_building[:, 1] - to_map[:, 1] * to_building[:, 0]),
            np.sum(to_map * to_building),
        )
        T = planar_pose(0.0, 0.0, yaw_rad)
        T[:2, 3] = in_building.mean(0) - T[:2, :2] @ in_map.mean(0)
        self._T_building_map = T

    def drive_to(self, goal: Array) -> float:
        """Send a goal (x, y, yaw in the map), and follow commands until it is reached; return seconds."""
        from geometry_msgs.msg import PoseStamped

        message = PoseStamped()
        message.header.frame_id, message.header.stamp = "map", self._stamp()
        message.pose.position.x, message.pose.position.y = float(goal[0]), float(goal[1])
        message.pose.orientation.z, message.pose.orientation.w = math.sin(goal[2] / 2), math.cos(goal[2] / 2)
        self.says_reached = False
        begin_s = self.time_s
        self._has_goal = True
        self._goals.publish(message)
        while not self.says_reached and self.time_s < begin_s + GOAL_S:
            is_fresh = self.time_s - self._commanded_s <= COMMAND_S
            self._advance(*self.base.step(*(self._command if is_fresh else (0.0, 0.0))))
        self._has_goal = False
        return self.time_s - begin_s

    def carry_away(self, rng: np.random.Generator) -> None:
        """Put the robot at another place of the tour, in any direction, where it stands for a while.

        Its wheels do not notice.
        """
        poses = self._tour.T_building_base
        x_m, y_m = poses[rng.integers(len(poses)), :2, 3].tolist()
        self.base = DifferentialBase(self._building, x_m, y_m, rng.uniform(-math.pi, math.pi))
        for _ in range(round(PUT_DOWN_S / STEP_S)):
            self._advance(*self.base.step(0.0, 0.0))

    def goal(self, rng: np.random.Generator) -> Array:
        """Return a random free place of the building, in the map."""
        y_m, x_m = rng.permutation(np.argwhere(self._building.is_free))[0] + 0.5
        place = inverse(self._T_building_map) @ np.array([x_m, y_m, 0.0, 1.0])
        return np.array([place[0], place[1], rng.uniform(-math.pi, math.pi)])

    def place(self) -> Array:
        """Return where the robot truly is in the map: x, y (m) and yaw (rad)."""
        T_map_base = inverse(self._T_building_map) @ self.base.T_building_base
        return np.array([*T_map_base[:2, 3], math.atan2(T_map_base[1, 0], T_map_base[0, 0])])

    def _advance(self, left_m: float, right_m: float) -> None:
        """Let the wheels turn for a step of the simulation; take an image if it is time."""
        _, self._T_odom_base = self._wheels.add(left_m, right_m)
        self.time_s += STEP_S
        self._publish_clock()
        self._publish_odometry()
        self._spin_once(self.node, timeout_sec=0.0)
        step = round((self.time_s - START_S) / STEP_S)
        if step % FRAME_STEPS == 0:
            self._observe()
        if self._prints_times and step % round(1.0 / STEP_S) == 0:
            print(f"time {self.time_s:.0f} s", flush=True)

    def _observe(self) -> None:
        """Publish an image with depth, and wait a limited time for its pose and for the next command."""
        from sensor_msgs.msg import CameraInfo, Image

        self._publish_odometry()
        colour, depth_m, cosine = self._renderer.draw(self.base.T_building_base @ T_BASE_CAMERA)
        info = CameraInfo(width=BASE_CAMERA.width, height=BASE_CAMERA.height, distortion_model="plumb_bob")
        info.k, info.p = (
            BASE_CAMERA.matrix.ravel(),
            np.column_stack((BASE_CAMERA.matrix, np.zeros(3))).ravel(),
        )
        info.header.stamp, info.header.frame_id = self._stamp(), CAMERA_FRAME
        stamp_ns = round(1e9 * self.time_s)
        self._truths[stamp_ns] = self.base.T_building_base
        self._infos.publish(info)
        millimetres = np.round(1000 * add_depth_noise(depth_m, cosine, self._rng)).astype(np.uint16)
        pictures = (COLOUR, add_image_noise(colour, self._rng), "rgb8"), (DEPTH, millimetres, "16UC1")
        for topic, pixels, encoding in pictures:
            image = Image(header=info.header, width=info.width, height=info.height, encoding=encoding)
            image.step, image.data = pixels.strides[0], pixels.tobytes()
            self._images[topic].publish(image)
        until_s = time.monotonic() + ANSWER_WAIT_S
        while not self._is_answered(stamp_ns) and (left_s := until_s - time.monotonic()) > 0.0:
            self._spin_once(self.node, timeout_sec=left_s)

    def _is_answered(self, stamp_ns: int) -> bool:
        """Return whether the pose of an image has come, and on the way to a goal a command after it."""
        is_commanded = not self._has_goal or self.says_reached or self._commanded_s > 1e-9 * stamp_ns - 1e-6
        return self._newest_pose_ns >= stamp_ns and is_commanded

    def _publish_clock(self) -> None:
        from rosgraph_msgs.msg import Clock

        self._clock.publish(Clock(clock=self._stamp()))

    def _publish_odometry(self) -> None:
        from nav_msgs.msg import Odometry
        from tf2_msgs.msg import TFMessage

        transform = self._transform("odom", "base_link", self._T_odom_base)
        message = Odometry(header=transform.header, child_frame_id="base_link")
        at, moved = message.pose.pose.position, transform.transform.translation
        at.x, at.y, message.pose.pose.orientation = moved.x, moved.y, transform.transform.rotation
        self._odometry.publish(message)
        self._transforms.publish(TFMessage(transforms=[transform]))

    def _transform(self, parent: str, child: str, T: Array):
        from geometry_msgs.msg import TransformStamped

        message = TransformStamped(child_frame_id=child)
        message.header.stamp, message.header.frame_id = self._stamp(), parent
        moved, turned = message.transform.translation, message.transform.rotation
        moved.x, moved.y, moved.z = T[:3, 3].tolist()
        turned.w = 0.5 * math.sqrt(max(0.0, 1.0 + np.trace(T[:3, :3])))
        turned.x, turned.y, turned.z = (
            float(T[2, 1] - T[1, 2]) / (4.0 * turned.w),
            float(T[0, 2] - T[2, 0]) / (4.0 * turned.w),
            float(T[1, 0] - T[0, 1]) / (4.0 * turned.w),
        )
        return message

    def _stamp(self):
        from builtin_interfaces.msg import Time

        seconds, nanoseconds = divmod(round(1e9 * self.time_s), 1_000_000_000)
        return Time(sec=seconds, nanosec=nanoseconds)

    def _on_command(self, message) -> None:
        twist, stamp = message.twist, message.header.stamp
        self._command, self._commanded_s = (twist.linear.x, twist.angular.z), stamp.sec + 1e-9 * stamp.nanosec

    def _on_goal_reached(self, message) -> None:
        self.says_reached = message.data

    def _on_status(self, message) -> None:
        self._status = message.data

    def _on_pose(self, message) -> None:
        stamp, at = message.header.stamp, message.pose.pose.position
        stamp_ns = 1_000_000_000 * stamp.sec + stamp.nanosec
        self._newest_pose_ns = max(self._newest_pose_ns, stamp_ns)
        if stamp_ns in self._truths and self._status == "visual":
            truth = inverse(self._T_building_map) @ self._truths[stamp_ns]
            self.wrong_poses += math.dist((at.x, at.y), truth[:2, 3]) > WRONG_M

    def _on_path(self, message) -> None:
        self._path = {
            1_000_000_000 * each.header.stamp.sec + each.header.stamp.nanosec: (
                each.pose.position.x,
                each.pose.position.y,
            )
            for each in message.poses
        }


def main(args: argparse.Namespace) -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Ctrl-C ends the program
    robot, rng = Robot(args), np.random.default_rng([args.seed, 1])
    robot.wait_for_bridge()
    robot.drive_tour(args.tour)
    wrong_before, robot.wrong_poses = robot.wrong_poses, 0
    robot.find_map()
    print(f"tour ended after {robot.time_s - START_S:.0f} s, {wrong_before} wrong poses", flush=True)
    reached = 0
    for number in range(args.goals):
        if number in args.carried:
            robot.carry_away(rng)
        goal, collisions, wrong = robot.goal(rng), robot.base.collisions, robot.wrong_poses
        print(f"goal {number} at {robot.time_s:.1f} s: x {goal[0]:.2f} m, y {goal[1]:.2f} m", flush=True)
        took_s = robot.drive_to(goal)
        x_m, y_m, yaw_rad = robot.place() - goal
        error_m, error_deg = math.hypot(x_m, y_m), abs(math.degrees(math.remainder(yaw_rad, math.tau)))
        is_reached = robot.says_reached and error_m <= REACHED_M and error_deg <= REACHED_DEG
        reached += is_reached
        print(
            f"goal {number} {'reached' if is_reached else 'MISSED' if robot.says_reached else 'GIVEN UP'}: "
            f"{100 * error_m:.1f} cm and {error_deg:.1f} degrees away after {took_s:.0f} s, "
            f"{robot.base.collisions - collisions} collisions, {robot.wrong_poses - wrong} wrong poses",
            flush=True,
        )
    print(f"{reached} of {args.goals} goals reached", flush=True)


if __name__ == "__main__":
    given = parser.parse_args()
    if not given.tour >= LEAST_TOUR_M:
        parser.error(f"--tour {given.tour:g} m is too short to make a map: at least {LEAST_TOUR_M:g} m")
    for name in ("goals", "seed"):
        if getattr(given, name) < 0:
            parser.error(f"--{name} {getattr(given, name):g} is negative: name 0 or more")
    if unknown := [number for number in given.carried if not 0 <= number < given.goals]:
        parser.error(f"--carried {unknown[0]}: there is no such goal, they are 0 to {given.goals - 1}")
    try:
        main(given)
    except KeyboardInterrupt:
        sys.exit(130)
    except ModuleNotFoundError as error:
        sys.exit(f"{error.name} is not installed: see docs/ros.md, or source the setup.bash of your ROS 2")
