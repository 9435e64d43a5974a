"""Drive a simulated robot on wheels to goals by the poses and the floor plan of its mapper."""

import argparse
import asyncio
import heapq
import math

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Frame, PoseQuery
from client_sdk.mapper import Mapper
from client_sdk.simulator.base import (
    BASE_CAMERA,
    FRAME_STEPS,
    MAX_TURN_RATE_RAD_S,
    RADIUS_M,
    STEP_S,
    T_BASE_CAMERA,
    DifferentialBase,
    SlippingWheels,
    pursue,
)
from client_sdk.simulator.building import BUILDINGS, Building, make_building
from client_sdk.simulator.renderer import Renderer, add_depth_noise, add_image_noise
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, inverse
from rse_pf.pnp import PnpOptions, refine_with_depth, solve_pnp
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, GridOptions, OccupancyGrid

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--building", choices=BUILDINGS, default="rooms", help="default: rooms")
parser.add_argument("--goals", type=int, default=5, help="random goals (default: 5)")
parser.add_argument("--seed", type=int, default=0, help="chooses start, goals and noise (default: 0)")

GRID = GridOptions(resolution_m=0.05, robot_height_m=1.0, step_m=0.1, floor_m=0.0, up=(0.0, 0.0, 1.0))
GRID_FRAMES = 8  # images from one floor plan to the next: 1.6 s
GOAL_S = 150.0  # longest time for a goal
CLEARANCE_M = RADIUS_M + 0.06  # distance that a path keeps from obstacles: the robot, and a cell for noise
COMFORT_M = 0.45  # cells nearer to an obstacle than this cost more, so that paths keep to the middle
NEAR_COST = 3.0  # factor of the cost of a cell nearer to an obstacle than COMFORT_M; a free cell costs 1
UNKNOWN_COST = 10.0  # cost of a cell that was not seen: behind a corner there may be a wall
TIGHT_COST = 30.0  # cost of a cell nearer to an obstacle than CLEARANCE_M, where a path has no other way
LOOK_AHEAD_M = 0.4  # the robot steers to the point of its path at this distance
ARRIVED_M = 0.04  # the robot stops at this distance from a goal
ARRIVED_RAD = 0.05  # the robot stops turning at this angle from the direction of a goal
SLOW_M = 0.6  # nearer to a goal than this, the speed falls with the distance
CREEP_M_S = 0.06  # slowest speed on the way to a goal
REACHED_M = 0.15  # largest true distance from a goal that counts as reached
REACHED_DEG = 10.0  # largest true error of the direction at a goal that counts as reached


def plan(grid: OccupancyGrid, start: Array, goal: Array) -> Array | None:
    """Return a path ``(n, 2)`` in metres by A* over the cells of a floor plan; None if there is none."""
    # 1. Enlarge the plan so that start and goal are inside: what was not seen may be free.
    low = np.minimum(np.array(grid.origin_m), np.minimum(start, goal) - 1.0)
    high = np.maximum(
        np.array(grid.origin_m) + np.array(grid.cells.shape[::-1]) * grid.resolution_m,
        np.maximum(start, goal) + 1.0,
    )
    offset = np.round((np.array(grid.origin_m) - low) / grid.resolution_m).astype(int)
    low = np.array(grid.origin_m) - offset * grid.resolution_m
    width, height = np.ceil((high - low) / grid.resolution_m).astype(int)
    cells = np.full((height, width), UNKNOWN, dtype=np.uint8)
    rows, columns = grid.cells.shape
    cells[offset[1] : offset[1] + rows, offset[0] : offset[0] + columns] = grid.cells
    # 2. Give each cell its cost; a robot that is too near to something already may leave.
    is_occupied = cells == OCCUPIED
    cost = np.where(cells == FREE, 1.0, UNKNOWN_COST)
    cost[grown(is_occupied, COMFORT_M / grid.resolution_m)] *= NEAR_COST
    is_tight, is_blocked = (grown(is_occupied, far / grid.resolution_m) for far in (CLEARANCE_M, RADIUS_M))
    (x0, y0), (x1, y1) = (np.floor((point - low) / grid.resolution_m).astype(int) for point in (start, goal))
    y, x = np.mgrid[:height, :width]
    near_ends = np.minimum(np.hypot(y - y0, x - x0), np.hypot(y - y1, x - x1)) * grid.resolution_m < 0.3
    cost[is_tight] = TIGHT_COST
    cost[is_blocked] = np.inf
    cost[is_blocked & near_ends & ~is_occupied] = TIGHT_COST
    # 3. Search.
    found = search(cost, (int(y0), int(x0)), (int(y1), int(x1)))
    return None if found is None else low + (np.array(found)[:, ::-1] + 0.5) * grid.resolution_m


def grown(is_set: np.ndarray, cells: float) -> np.ndarray:
    """Return the cells within a distance, in cells, of those that are set."""
    reach = math.floor(cells)
    padded, result = np.pad(is_set, reach), np.zeros_like(is_set)
    height, width = is_set.shape
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if math.hypot(dy, dx) <= cells:
                result |= padded[reach + dy : reach + dy + height, reach + dx : reach + dx + width]
    return result


def search(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]] | None:
    """Return the cheapest way between two cells over their eight neighbours by A*; None if there is none."""
    costs, (height, width) = cost.tolist(), cost.shape  # numbers of Python: numpy is slow for single cells
    best, parents, done = {start: 0.0}, {start: start}, set[tuple[int, int]]()
    queue = [(0.0, start)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell in done:
            continue
        done.add(cell)
        if cell == goal:
            way = [cell]
            while way[-1] != start:
                way.append(parents[way[-1]])
            return way[::-1]
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            near = (cell[0] + dy, cell[1] + dx)
            if not (0 <= near[0] < height and 0 <= near[1] < width):
                continue
            total = best[cell] + math.hypot(dy, dx) * costs[near[0]][near[1]]
            if total < best.get(near, math.inf):
                best[near], parents[near] = total, cell
                heapq.heappush(queue, (total + math.hypot(near[0] - goal[0], near[1] - goal[1]), near))
    return None


class Navigator:
    """Plan and steer by what a node of ROS 2 gets: a pose, its status, and an occupancy grid."""

    def __init__(self, goal: Array) -> None:
        self.goal = goal  # x, y (m) and yaw (rad) in the world
        self.path: Array | None = None

    def replan(self, grid: OccupancyGrid, x_m: float, y_m: float) -> None:
        self.path = plan(grid, np.array([x_m, y_m]), self.goal[:2])

    def command(self, x_m: float, y_m: float, yaw_rad: float, status: str) -> tuple[float, float] | None:
        """Return forward speed (m/s) and turn rate (rad/s); None at the goal."""
        if status == "lost":
            return 0.0, 0.5 * MAX_TURN_RATE_RAD_S  # look around for a known place
        left_m = math.hypot(self.goal[0] - x_m, self.goal[1] - y_m)
        if left_m < ARRIVED_M or (self.path is not None and len(self.path) == 1):
            angle = math.remainder(self.goal[2] - yaw_rad, 2.0 * math.pi)
            return None if abs(angle) < ARRIVED_RAD else (0.0, float(np.clip(2.0 * angle, -0.6, 0.6)))
        if self.path is None:
            return 0.0, 0.5 * MAX_TURN_RATE_RAD_S  # look around: the plan may have a gap
        nearest = int(np.argmin(np.hypot(self.path[:, 0] - x_m, self.path[:, 1] - y_m)))
        along = np.cumsum(np.linalg.norm(np.diff(self.path[nearest:], axis=0), axis=1))
        ahead = nearest + int(np.searchsorted(along, LOOK_AHEAD_M)) + 1
        target = self.path[ahead] if ahead < len(self.path) else self.goal[:2]
        speed, turn_rate = pursue(x_m, y_m, yaw_rad, target)
        slower = 0.7 * min(1.0, left_m / SLOW_M) * (0.5 if status == "odometry" else 1.0)
        if speed > 0.0:
            slower = max(slower, min(1.0, CREEP_M_S / speed))
            return slower * speed, slower * turn_rate
        return speed, 0.75 * turn_rate


class SimulatedRobot:
    """A base with a camera and wheel odometry in a building."""

    def __init__(self, building: Building, x_m: float, y_m: float, yaw_rad: float, seed: int) -> None:
        self.base = DifferentialBase(building, x_m, y_m, yaw_rad)
        self.T_building_start = self.base.T_building_base
        self._wheels = SlippingWheels(seed)
        self._renderer = Renderer(building.world, BASE_CAMERA)
        self._rng = np.random.default_rng(seed)
        self._readings: list[OdometryReading] = []
        self.timestamp_s = 0.0

    def observe(self) -> tuple[Frame, list[OdometryReading]]:
        """Return an image, and the readings of the wheels since the last one."""
        readings, self._readings = self._readings, []
        colour, depth_m, cosine = self._renderer.draw(self.base.T_building_base @ T_BASE_CAMERA)
        frame = Frame(
            timestamp_s=self.timestamp_s,
            rgb=add_image_noise(colour, self._rng),
            depth_m=add_depth_noise(depth_m, cosine, self._rng),
            camera=BASE_CAMERA,
        )
        return frame, readings

    def drive(self, speed_m_s: float, turn_rate_rad_s: float) -> None:
        """Drive until the time of the next image."""
        for _ in range(FRAME_STEPS):
            stamp_s, T_odom_base = self._wheels.add(*self.base.step(speed_m_s, turn_rate_rad_s))
            self._readings.append(OdometryReading(timestamp_s=stamp_s, T_odom_base=T_odom_base))
        self.timestamp_s += FRAME_STEPS * STEP_S

    def place(self) -> Array:
        """Return where the robot truly is: x, y (m) and yaw (rad) in the frame of its start."""
        T_start_base = inverse(self.T_building_start) @ self.base.T_building_base
        return np.array([*T_start_base[:2, 3], yaw_of(T_start_base)])


def yaw_of(T_world_base: Array) -> float:
    return math.atan2(T_world_base[1, 0], T_world_base[0, 0])


async def solve(query: PoseQuery) -> PoseAnswer:
    """Solve a pose query here; with a platform, `robot.mapper()` asks that."""
    options, matches = PnpOptions(inlier_px=query.inlier_px), query.correspondences
    solution = solve_pnp(matches.points_world, matches.pixels, query.camera, options)
    if matches.depths_m.any():
        solution = refine_with_depth(
            solution, matches.points_world, matches.pixels, matches.depths_m, query.camera
        )
    return PoseAnswer(
        solution=solution, source="robot", server="", round_trip_ms=0.0, queue_ms=0.0, compute_ms=0.0
    )


async def drive_to(robot: SimulatedRobot, mapper: Mapper, goal: Array) -> bool:
    """Drive to a goal (x, y, yaw) in the world of the mapper; return whether the robot says it is there."""
    navigator = Navigator(goal)
    for number in range(round(GOAL_S / (FRAME_STEPS * STEP_S))):
        frame, readings = robot.observe()
        tracked = await mapper.track(frame, odometry=readings)
        command: tuple[float, float] | None = (0.0, 0.0)
        if tracked.T_world_base is not None:
            x_m, y_m = tracked.T_world_base[:2, 3].tolist()
            if number % GRID_FRAMES == 0:
                navigator.replan(await asyncio.to_thread(mapper.floor_plan, GRID), x_m, y_m)
            command = navigator.command(x_m, y_m, yaw_of(tracked.T_world_base), tracked.pose_source)
        robot.drive(*(command or (0.0, 0.0)))
        if command is None:
            return True
    return False


async def main(args: argparse.Namespace) -> None:
    building = make_building(args.building, args.seed)
    rng = np.random.default_rng(args.seed)
    squares = rng.permutation(np.argwhere(building.is_free))[: args.goals + 1, ::-1] + 0.5
    x_m, y_m = squares[0].tolist()
    robot = SimulatedRobot(building, x_m, y_m, rng.uniform(-math.pi, math.pi), args.seed)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA, keyframes_of="robot-1")
    T_start_building = inverse(robot.T_building_start)
    positions = squares[1:] @ T_start_building[:2, :2].T + T_start_building[:2, 3]
    goals = np.column_stack((positions, rng.uniform(-math.pi, math.pi, len(positions))))
    places = goals.copy()
    for name in ("explores", "returns"):
        reached = 0
        for number, goal in enumerate(goals):
            begin_s = robot.timestamp_s
            says_so = await drive_to(robot, mapper, goal)
            x_m, y_m, yaw_rad = robot.place() - places[number]
            error_m, error_deg = math.hypot(x_m, y_m), abs(math.degrees(math.remainder(yaw_rad, math.tau)))
            is_reached = says_so and error_m <= REACHED_M and error_deg <= REACHED_DEG
            reached += is_reached
            print(
                f"{name}: goal {number} {'reached' if is_reached else 'MISSED'}, {100 * error_m:.1f} cm and "
                f"{error_deg:.1f} degrees away after {robot.timestamp_s - begin_s:.0f} s",
                flush=True,
            )
            # When it returns, a goal is the place where the robot was for the same pose of its mapper.
            places[number] = robot.place()
        print(
            f"{name}: {reached} of {len(goals)} goals reached, {robot.base.collisions} collisions", flush=True
        )


if __name__ == "__main__":
    given = parser.parse_args()
    if given.goals < 1:
        parser.error(f"--goals {given.goals} is not above 0: name how many goals there are")
    if given.seed < 0:
        parser.error(f"--seed {given.seed} is negative: name 0 or more")
    try:
        asyncio.run(main(given))
    except KeyboardInterrupt:
        pass
    except RsePfError as error:
        raise SystemExit(str(error)) from None
