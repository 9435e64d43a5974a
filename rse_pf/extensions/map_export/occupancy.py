"""Encode the floor plan of a map as the files of the ROS map_server.

Source:
    ROS map_server and nav2_map_server: image, resolution, origin, negate, occupied_thresh, free_thresh.
"""

from __future__ import annotations

from rse_pf.geometry import Array, to_quaternion
from rse_pf.slam.occupancy import OccupancyGrid

__all__ = ["encode_occupancy"]


def encode_occupancy(grid: OccupancyGrid) -> dict[str, bytes]:
    """Return the image ``map.pgm`` and its description ``map.yaml`` for ROS's map_server, by their names.

    The image has the row of cells with the highest y first.  Comments in ``map.yaml`` state the height of the
    floor, ``T_grid_world``, and the ROS 2 command that publishes it.
    """
    height, width = grid.cells.shape
    image = f"P5\n{width} {height}\n255\n".encode("ascii") + grid.cells[::-1].tobytes()
    x, y = grid.origin_m
    rows = [", ".join(f"{number:.9g}" for number in row) for row in grid.T_grid_world]
    lines = [
        f"# The floor is at z = {grid.floor_m:.3f} m; up is by {grid.up_source}.",
        "# T_grid_world, from the world of the map to that of this grid:",
        *(f"#   [{row}]" for row in rows),
        "# The same for ROS 2, with the frame `map` of the bridge below the frame `plan` of this grid:",
        f"#   {_ros2_static_transform(grid.T_grid_world)}",
        "image: map.pgm",
        "mode: trinary",
        f"resolution: {grid.resolution_m:.6g}",
        f"origin: [{x:.6f}, {y:.6f}, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]
    return {"map.pgm": image, "map.yaml": ("\n".join(lines) + "\n").encode("ascii")}


def _ros2_static_transform(T_grid_world: Array) -> str:
    """Return the ROS 2 command to publish ``T_grid_world``, the pose of ``map`` in its parent ``plan``."""
    x, y, z = T_grid_world[:3, 3]
    qx, qy, qz, qw = to_quaternion(T_grid_world[:3, :3])
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {x:.6f} --y {y:.6f} --z {z:.6f} "
        f"--qx {qx:.9f} --qy {qy:.9f} --qz {qz:.9f} --qw {qw:.9f} --frame-id plan --child-frame-id map"
    )
