"""Drive a simulated robot with two driven wheels through a building, and measure its wheels and its camera.

The base frame lies on the floor between the wheels: x points forward, y left, z up.  The frame of the
building is the world of `Building`.  Time runs in steps of `STEP_S`; the same arguments give the same drive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from client_sdk.frontend import Frame
from client_sdk.simulator.building import Building
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, planar_pose

__all__ = [
    "BASE_CAMERA",
    "FRAME_STEPS",
    "STEP_S",
    "T_BASE_CAMERA",
    "BaseDrive",
    "DifferentialBase",
    "Lie",
    "SlippingWheels",
    "drive_route",
    "pursue",
    "render_base",
    "tilted_mount",
]

STEP_S = 0.04  # seconds of a step of the simulation: wheel odometry of 25 Hz
FRAME_STEPS = 5  # steps from one image to the next: 5 Hz
BASE_CAMERA = Camera(fx=200.0, fy=200.0, cx=159.5, cy=119.5, width=320, height=240)
"""Intrinsics of the camera on the base, which sees 77 degrees: it sees past a wall before which it turns."""

SEPARATION_M = 0.35  # distance of the two wheels, that of a small service robot
RADIUS_M = 0.22  # radius of the base: a wall that is nearer stops it
MAX_SPEED_M_S = 0.7  # largest forward speed
MAX_TURN_RATE_RAD_S = 0.8  # largest turn rate: 9 degrees between two images
_MAX_ACCELERATION_M_S2 = 1.0  # largest change of the forward speed
_MAX_TURN_ACCELERATION_RAD_S2 = 2.5  # largest change of the turn rate

SLIP_DEVIATION = 0.05  # standard deviation of the slip of a wheel in a step, as a share of its way
SLIP_BIAS = 0.01  # mean slip of a wheel, with a sign of its own: a radius that is stated wrongly by 1 %
_SCALE_LIE = 1.2  # factor of the lie ``scale``
_LATE_LIE_S = 0.1  # delay of the stamps of the lie ``late``

_LOOK_AHEAD_M = 0.4  # pure pursuit steers to the point of the route at this distance along it
_TURN_IN_PLACE_RAD = 0.8  # a larger angle to that point is turned at rest
_REACHED_M = 0.1  # a route ends this near to its last point
_PROGRESS_POINTS = 60  # points of a route, 1 cm apart, among which the nearest one is searched in a step
_MAX_STEPS_PER_POINT = 5
"""Steps for each point of a route (1 cm) after which a drive ends, so that a base that is stuck does not
drive for ever: 5 cm/s."""
_REST_STEPS = 25  # steps at rest before a drive begins: 1 s

Lie = Literal["none", "scale", "blocked", "late", "frozen"]
"""What wheel odometry reports wrongly: all ways 20 % too long, no way of the left wheel, stamps 100 ms late,
or the same pose for ever."""


def tilted_mount(forward_m: float, height_m: float, down_deg: float) -> Array:
    """Return ``T_base_camera`` ``(4, 4)`` of a camera that looks forward and *down_deg* below the horizon."""
    down = math.radians(down_deg)
    z = np.array([math.cos(down), 0.0, -math.sin(down)])
    x = np.array([0.0, -1.0, 0.0])
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    T_base_camera[:3, 3] = [forward_m, 0.0, height_m]
    return T_base_camera


T_BASE_CAMERA = tilted_mount(0.1, 0.7, 12.0)
"""Mount of the camera of a drive: 0.7 m above the floor, 12 degrees down."""


class DifferentialBase:
    """A base with two driven wheels, which walls, shelves and boxes stop.

    Attributes:
        x_m: Position in the building.
        y_m: Position in the building.
        yaw_rad: Direction of the base's x axis, counter-clockwise from x of the building.
        collisions: Number of times that the base ran against something after it had been free.
    """

    def __init__(self, building: Building, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Put the base at rest at a place of the building.

        Raises:
            UsageError: The base does not fit there.
        """
        if building.distance_m(x_m, y_m) < RADIUS_M:
            raise UsageError(
                f"({x_m:.2f}, {y_m:.2f}) m is less than {RADIUS_M:g} m from a wall or furniture",
                hint="start in the middle of a free square of the plan",
            )
        self._building = building
        self.x_m, self.y_m, self.yaw_rad = x_m, y_m, yaw_rad
        self.collisions = 0
        self._speed_m_s = self._turn_rate_rad_s = 0.0
        self._is_blocked = False

    @property
    def T_building_base(self) -> Array:
        """Exact pose ``(4, 4)`` in the building, metres."""
        return planar_pose(self.x_m, self.y_m, self.yaw_rad)

    def step(self, speed_m_s: float, turn_rate_rad_s: float) -> tuple[float, float]:
        """Drive for `STEP_S` towards a forward speed and a turn rate (positive to the left).

        The base keeps to its largest speeds and accelerations.  Where it would run against something it stays
        in place, its wheels slip, and it can only turn.

        Returns:
            The ways in metres that the left and the right wheel turned.
        """
        speed_m_s = float(np.clip(speed_m_s, -MAX_SPEED_M_S, MAX_SPEED_M_S))
        turn = float(np.clip(turn_rate_rad_s, -MAX_TURN_RATE_RAD_S, MAX_TURN_RATE_RAD_S))
        self._speed_m_s = _towards(self._speed_m_s, speed_m_s, _MAX_ACCELERATION_M_S2)
        self._turn_rate_rad_s = _towards(self._turn_rate_rad_s, turn, _MAX_TURN_ACCELERATION_RAD_S2)
        way_m, angle_rad = self._speed_m_s * STEP_S, self._turn_rate_rad_s * STEP_S
        x_m, y_m, yaw_rad = _moved(self.x_m, self.y_m, self.yaw_rad, way_m, angle_rad)
        was_blocked, self._is_blocked = self._is_blocked, self._building.distance_m(x_m, y_m) < RADIUS_M
        if self._is_blocked:
            self.collisions += not was_blocked
        else:
            self.x_m, self.y_m = x_m, y_m
        self.yaw_rad = yaw_rad
        half_m = 0.5 * SEPARATION_M * angle_rad
        return way_m - half_m, way_m + half_m


class SlippingWheels:
    """Odometry of two wheels that slip by 5 % at random in each step; each is 1 % too large or too small.

    The odometry frame is the base frame at the start of the drive.
    """

    def __init__(self, seed: int, *, lie: Lie = "none", lies_after_s: float = 0.0) -> None:
        """Begin at time 0; *seed* chooses the slip, and the *lie* begins *lies_after_s* seconds later."""
        self._rng = np.random.default_rng([seed, 31])
        self._mean = 1.0 + SLIP_BIAS * self._rng.choice((-1.0, 1.0), 2)
        self._lie, self._lies_after_s = lie, lies_after_s
        self._steps = 0
        self._x_m = self._y_m = self._yaw_rad = 0.0

    def add(self, left_m: float, right_m: float) -> tuple[float, Array]:
        """Add the ways of the wheels in one step; return the stamp (s) and ``T_odom_base`` of the reading."""
        self._steps += 1
        stamp_s = self._steps * STEP_S
        lie: Lie = self._lie if stamp_s > self._lies_after_s else "none"
        slip = self._mean + SLIP_DEVIATION * self._rng.standard_normal(2)
        left_m, right_m = left_m * slip[0], right_m * slip[1]
        if lie == "blocked":
            left_m = 0.0
        if lie != "frozen":
            scale = _SCALE_LIE if lie == "scale" else 1.0
            way_m, angle_rad = 0.5 * scale * (left_m + right_m), scale * (right_m - left_m) / SEPARATION_M
            self._x_m, self._y_m, self._yaw_rad = _moved(
                self._x_m, self._y_m, self._yaw_rad, way_m, angle_rad
            )
        late_s = _LATE_LIE_S if lie == "late" else 0.0
        return stamp_s + late_s, planar_pose(self._x_m, self._y_m, self._yaw_rad)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BaseDrive:
    """An exact drive of a base.

    Attributes:
        T_building_base: ``(n + 1, 4, 4)``, the pose at the start and after each of n steps.
        wheels_m: ``(n, 2)``, the ways of the left and the right wheel in each step.
        collisions: How often the base ran against something.
    """

    T_building_base: Array
    wheels_m: Array
    collisions: int

    @property
    def truth(self) -> Trajectory:
        """Exact poses of the base at the images: the first one at time 0, then every `FRAME_STEPS` steps."""
        poses = self.T_building_base[::FRAME_STEPS]
        stamps_s: Array = FRAME_STEPS * STEP_S * np.arange(len(poses), dtype=np.float64)
        return Trajectory(stamps_s, poses)

    def odometry(
        self, seed: int, *, lie: Lie = "none", lies_after_s: float = 0.0
    ) -> list[list[tuple[float, Array]]]:
        """Return, for each image, the stamps and poses of `SlippingWheels` since the image before."""
        wheels = SlippingWheels(seed, lie=lie, lies_after_s=lies_after_s)
        readings = [wheels.add(left_m, right_m) for left_m, right_m in self.wheels_m]
        return [
            readings[max(0, last - FRAME_STEPS) : last]
            for last in range(0, len(self.wheels_m) + 1, FRAME_STEPS)
        ]


def drive_route(building: Building, route: Array) -> BaseDrive:
    """Drive along a route ``(n, 2)`` of `Building.route` by pure pursuit, after 1 s at rest.

    The drive ends at the last point of the route, or unfinished where the base is stuck.
    """
    yaw_rad = math.atan2(*(route[10] - route[0])[::-1])
    base = DifferentialBase(building, float(route[0, 0]), float(route[0, 1]), yaw_rad)
    poses, wheels = [base.T_building_base], list[tuple[float, float]]()
    progress, is_at_end = 0, False
    while len(wheels) % FRAME_STEPS or not (is_at_end or len(wheels) > _MAX_STEPS_PER_POINT * len(route)):
        near = route[progress : progress + _PROGRESS_POINTS]
        progress += int(np.argmin(np.hypot(near[:, 0] - base.x_m, near[:, 1] - base.y_m)))
        ahead = route[min(progress + round(100 * _LOOK_AHEAD_M), len(route) - 1)]
        left_m = math.hypot(route[-1, 0] - base.x_m, route[-1, 1] - base.y_m)
        is_at_end = progress > len(route) - 100 * _LOOK_AHEAD_M and left_m < _REACHED_M
        command = (0.0, 0.0)
        if len(wheels) >= _REST_STEPS and not is_at_end:
            command = pursue(base.x_m, base.y_m, base.yaw_rad, ahead)
        wheels.append(base.step(*command))
        poses.append(base.T_building_base)
    return BaseDrive(T_building_base=np.array(poses), wheels_m=np.array(wheels), collisions=base.collisions)


def pursue(x_m: float, y_m: float, yaw_rad: float, target: Array) -> tuple[float, float]:
    """Return forward speed (m/s) and turn rate (rad/s) that lead to a target (x, y) on an arc.

    A target that is far to the side is turned to at rest.

    Source:
        Coulter, Implementation of the pure pursuit path tracking algorithm, CMU-RI-TR-92-01, 1992.
    """
    dx, dy = float(target[0]) - x_m, float(target[1]) - y_m
    angle = math.remainder(math.atan2(dy, dx) - yaw_rad, 2.0 * math.pi)
    if abs(angle) > _TURN_IN_PLACE_RAD:
        return 0.0, math.copysign(MAX_TURN_RATE_RAD_S, angle)
    curvature = 2.0 * math.sin(angle) / max(math.hypot(dx, dy), 0.05)
    speed = min(MAX_SPEED_M_S, MAX_TURN_RATE_RAD_S / max(abs(curvature), 1e-6))
    return speed, speed * curvature


def render_base(
    building: Building,
    truth: Trajectory,
    noise: Sequence[int],
    *,
    T_base_camera: Array = T_BASE_CAMERA,
    camera: Camera = BASE_CAMERA,
) -> Iterator[Frame]:
    """Yield the RGB-D frames of the camera on a base.

    Args:
        building: The building to draw.
        truth: Pose of the base in the building and time stamp of each frame.
        noise: Numbers that, followed by the index of the frame in *truth*, seed the noise of image and depth.
        T_base_camera: ``(4, 4)`` pose of the camera in the base frame, metres.
        camera: Intrinsics of the images.
    """
    renderer = Renderer(building.world, camera)
    for row, (stamp_s, pose) in enumerate(zip(truth.timestamps_s, truth.T_world_camera, strict=True)):
        rng = np.random.default_rng([*noise, row])
        colour, depth_m, cosine = renderer.draw(pose @ T_base_camera)
        yield Frame(
            timestamp_s=float(stamp_s),
            rgb=add_image_noise(colour, rng),
            depth_m=add_depth_noise(depth_m, cosine, rng),
            camera=camera,
        )


def _moved(
    x_m: float, y_m: float, yaw_rad: float, way_m: float, angle_rad: float
) -> tuple[float, float, float]:
    """Return the place at the end of an arc of a length and an angle, whose chord lies at half the angle."""
    chord_m = way_m * float(np.sinc(angle_rad / (2.0 * np.pi)))
    middle_rad = yaw_rad + 0.5 * angle_rad
    return (
        x_m + chord_m * math.cos(middle_rad),
        y_m + chord_m * math.sin(middle_rad),
        yaw_rad + angle_rad,
    )


def _towards(value: float, wanted: float, acceleration: float) -> float:
    """Return *value*, changed towards *wanted* by at most what an acceleration allows in a step."""
    limit = acceleration * STEP_S
    return value + min(max(wanted - value, -limit), limit)
