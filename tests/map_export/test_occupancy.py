"""Floor plans compared with the true plan of a rendered world, their files, and too large grids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.occupancy import encode_occupancy
from rse_pf.geometry import Array, exp_se3, from_quaternion, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.level_surfaces import floor_normal
from rse_pf.slam.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridOptions,
    OccupancyGrid,
    level_map,
    make_occupancy_grid,
)
from tests.kit.exact_maps import CAMERA, shares_right, world_map

UP = GridOptions(up=(0.0, 0.0, 1.0))


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin_m) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])


def room(*, looks: Array | None = None, T: Array | None = None) -> MapVersion:
    """Return a floor of 4 x 4 m with a box in it and a wall beyond, and a camera that looks along x."""
    spots = np.arange(0.01, 4.0, 0.02)
    x, y = (each.ravel() for each in np.meshgrid(spots, spots))
    floor = np.column_stack([x, y, np.zeros(len(x))])
    floor = floor[(floor[:, 0] < 2.0) & ~((floor[:, 0] > 1.0) & (floor[:, 1] > 3.0))]
    heights = np.arange(0.0, 2.6, 0.02)
    beside, up = (each.ravel() for each in np.meshgrid(spots, heights))
    wall = np.column_stack([np.full(len(up), 3.53), beside, up])
    box = np.column_stack([x, y, np.full(len(x), 0.5)])
    box = box[(box[:, 0] > 1.0) & (box[:, 0] < 1.5) & (box[:, 1] > 3.0) & (box[:, 1] < 3.5)]
    high = np.column_stack([x, y, np.full(len(x), 2.5)])
    points = np.concatenate([floor, wall, box, high]).astype(np.float32)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = (0.5, 2.0, 1.0)
    seen = np.array([[0.0, 0.0, 3.0], [0.0, -1.2, 3.0]]) if looks is None else looks
    turn = np.eye(4) if T is None else T
    n = len(seen)
    keyframe = Keyframe(
        id=0,
        robot="r",
        timestamp_s=0.0,
        T_world_camera=turn @ pose,
        camera=CAMERA,
        pixels=np.ones((n, 2), np.float32),
        descriptors=np.zeros((n, 32), np.uint8),
        points_camera=seen.astype(np.float32),
    )
    moved = transform(turn, points.astype(np.float64)).astype(np.float32)
    colours = np.zeros((len(points), 3), dtype=np.uint8)
    return MapVersion(keyframes=(keyframe,), points=moved, colours=colours)


def test_at_least_95_percent_of_seen_cells_of_a_rendered_world_are_right() -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

    grid = make_occupancy_grid(world_map(), UP)

    right, right_free, right_occupied = shares_right(grid, 0.1, 1.5)
    assert abs(grid.floor_m) < 0.02
    assert (grid.cells != UNKNOWN).sum() > 8000
    assert right >= 0.95
    assert right_free >= 0.97
    assert right_occupied >= 0.75  # noise of depth puts points of a wall into the cell before it


def test_without_gravity_up_is_found_across_the_floors_that_are_seen() -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    version = world_map()
    tilted = exp_se3(np.array([0.3, 0.1, -0.2, 0.25, -0.15, 0.4]))
    moved = replace(
        version,
        keyframes=tuple(
            replace(keyframe, T_world_camera=tilted @ keyframe.T_world_camera)
            for keyframe in version.keyframes
        ),
        points=transform(tilted, version.points.astype(np.float64)).astype(np.float32),
    )

    grid = make_occupancy_grid(moved)

    up = grid.T_grid_world[:3, :3] @ tilted[:3, :3] @ [0.0, 0.0, 1.0]
    assert grid.up_source == "the floor"
    assert np.degrees(np.arccos(up[2])) < 0.15


def long_floor(tilt_deg: float, *, width_m: float = 4.0, step_m: float = 0.0) -> tuple[Array, Array]:
    """Return a tilted floor of 14 m with furniture on a third of it (0.4 to 0.8 m), and camera positions."""
    rng = np.random.default_rng(6)
    points = np.column_stack([rng.uniform(0, 14, 60_000), rng.uniform(0, width_m, 60_000), np.zeros(60_000)])
    points[:, 2] = np.where(points[:, 0] > 7.0, step_m, 0.0) + 0.008 * rng.standard_normal(60_000)
    stands = (np.floor(points[:, 0] / 0.7).astype(int) % 3 == 0) & (points[:, 1] > 1.0)
    points[stands, 2] += rng.uniform(0.4, 0.8, stands.sum())
    places = np.column_stack([np.linspace(1, 13, 20), np.full(20, width_m / 2), np.full(20, 1.2)])
    turn = exp_se3(np.array([0, 0, 0, 0.0, np.radians(tilt_deg), 0.0]))
    return transform(turn, points), transform(turn, places)


@pytest.mark.parametrize("tilt_deg", [-3.0, 0.0, 1.6])
def test_a_long_floor_tells_up_better_than_its_parts(tilt_deg: float) -> None:
    points, places = long_floor(tilt_deg)

    up = floor_normal(points.astype(np.float32), np.array([0.0, 0.0, 1.0]), places)

    assert up is not None
    wanted = exp_se3(np.array([0, 0, 0, 0.0, np.radians(tilt_deg), 0.0]))[:3, 2]
    assert np.degrees(np.arccos(min(1.0, float(up @ wanted)))) < 0.1


@pytest.mark.parametrize(
    "floor",
    [long_floor(8.0), long_floor(0.0, width_m=0.7), long_floor(0.0, step_m=0.9)],
    ids=["a ramp", "a corridor of 0.7 m", "two storeys"],
)
def test_a_floor_that_tells_no_up_is_not_asked(floor: tuple[Array, Array]) -> None:
    points, places = floor

    assert floor_normal(points.astype(np.float32), np.array([0.0, 0.0, 1.0]), places) is None


def test_a_look_frees_what_it_passes_at_the_height_of_the_robot_alone() -> None:
    grid = make_occupancy_grid(room(looks=np.array([[0.0, 0.0, 3.0]])), UP)
    above = make_occupancy_grid(room(looks=np.array([[0.0, -1.4, 2.2]])), UP)

    assert at(grid, 2.8, 2.0) == FREE
    assert at(grid, 3.52, 2.0) == OCCUPIED
    assert at(above, 2.4, 2.0) == UNKNOWN


def test_a_base_whose_height_and_tilt_have_drifted_stands_on_the_floor() -> None:
    T_base_camera = room().keyframes[0].T_world_camera.copy()
    T_base_camera[:2, 3] = 0.0
    drift = exp_se3(np.array([0.0, 0.0, 0.3, 0.02, -0.03, 0.0]))
    drifted = room(T=drift)
    unlevel = make_occupancy_grid(drifted, replace(UP, floor_m=0.0))

    grid = make_occupancy_grid(level_map(drifted, T_base_camera), UP)

    assert at(unlevel, 0.5, 3.6) == OCCUPIED
    assert [at(grid, x, 2.0) for x in (0.3, 1.0, 1.8)] == [FREE] * 3
    assert [at(grid, 0.5, y) for y in (0.4, 2.0, 3.6)] == [FREE] * 3
    assert at(grid, 1.25, 3.25) == OCCUPIED
    assert OCCUPIED in {at(grid, x, 2.0) for x in np.arange(3.45, 3.58, 0.03)}


def test_a_map_that_knows_gravity_is_turned_and_the_file_says_how() -> None:
    down = np.eye(4)
    down[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # z of the room becomes -y
    version = replace(room(T=down), provenance={"up": [0.0, -1.0, 0.0]})

    grid = make_occupancy_grid(version)

    assert grid.up_source == "the map"
    np.testing.assert_allclose(grid.T_grid_world @ down, np.eye(4), atol=1e-9)
    assert at(grid, 1.2, 3.2) == OCCUPIED
    assert b"# T_grid_world" in encode_occupancy(grid)["map.yaml"]


def test_the_file_names_the_static_transform_of_ros() -> None:
    T_grid_world = exp_se3([0.3, -1.2, 0.7, 0.4, -1.1, 2.0])
    grid = replace(make_occupancy_grid(room(), UP), T_grid_world=T_grid_world)

    (command,) = (
        line
        for line in encode_occupancy(grid)["map.yaml"].decode().splitlines()
        if "static_transform" in line
    )

    words = command.split()
    reported = {
        name: float(words[words.index(f"--{name}") + 1]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")
    }
    turn = from_quaternion([reported[name] for name in ("qx", "qy", "qz", "qw")])
    np.testing.assert_allclose(turn, T_grid_world[:3, :3], atol=1e-6)
    np.testing.assert_allclose([reported[name] for name in "xyz"], T_grid_world[:3, 3], atol=1e-6)
    assert command.endswith("--frame-id plan --child-frame-id map")


def test_the_files_are_those_of_map_server() -> None:
    yaml = pytest.importorskip("yaml", reason="pip install 'rse-pf[vision]'")
    grid = make_occupancy_grid(room(), UP)

    files = encode_occupancy(grid)

    about = yaml.safe_load(files["map.yaml"])
    head, size, most, data = files["map.pgm"].split(b"\n", 3)
    width, height = map(int, size.split())
    image = np.frombuffer(data, dtype=np.uint8).reshape(height, width)
    assert (head, most) == (b"P5", b"255")
    assert about == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "origin": [*(round(each, 6) for each in grid.origin_m), 0.0],
    }
    # As map_server reads it: the lowest row of the image is that of the origin.
    row = height - 1 - int((3.2 - about["origin"][1]) / 0.05)
    column = int((1.2 - about["origin"][0]) / 0.05)
    darkness = (255 - int(image[row, column])) / 255
    assert darkness > about["occupied_thresh"]
    assert (255 - FREE) / 255 < about["free_thresh"] < (255 - UNKNOWN) / 255 < about["occupied_thresh"]


def test_points_far_from_all_poses_are_left_out_and_counted() -> None:
    version = room()
    wild = np.array([[1e8, 0, 0], [0, -9e8, 0], [5e4, 1, 1]], dtype=np.float32)
    more = replace(
        version,
        points=np.concatenate([version.points, wild]),
        colours=np.concatenate([version.colours, np.zeros((3, 3), np.uint8)]),
    )

    grid = make_occupancy_grid(more, UP)

    assert grid.points_left_out == 3
    np.testing.assert_array_equal(grid.cells, make_occupancy_grid(version, UP).cells)


@pytest.mark.parametrize("far_m", [3e4, 9e8])
def test_poses_far_apart_make_no_huge_grid(far_m: float) -> None:
    version = room()
    far = version.keyframes[0].T_world_camera.copy()
    far[:2, 3] = far_m

    with pytest.raises(UsageError, match=r"cells, above 16777216") as refused:
        make_occupancy_grid(
            replace(
                version,
                keyframes=(*version.keyframes, replace(version.keyframes[0], id=1, T_world_camera=far)),
            ),
            UP,
        )

    assert refused.value.hint


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ({"resolution_m": 0.0}, "--resolution"),
        ({"resolution_m": float("nan")}, "--resolution"),
        ({"robot_height_m": -1.0}, "--robot-height"),
        ({"step_m": 2.0}, "--step"),
        ({"floor_m": float("inf")}, "--floor"),
        ({"up": (0.0, 0.0, 0.0)}, "--up"),
        ({"up": (float("nan"), 0.0, 0.0)}, "--up"),
    ],
)
def test_options_out_of_range_are_refused(words: dict[str, float], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        GridOptions(**words)  # type: ignore[arg-type]


def test_maps_without_points_keyframes_or_up_are_refused_in_one_line() -> None:
    version = room()
    with pytest.raises(UsageError, match="no points"):
        make_occupancy_grid(MapVersion(keyframes=version.keyframes), UP)
    with pytest.raises(UsageError, match="without keyframes"):
        make_occupancy_grid(replace(version, keyframes=()), UP)
    first = version.keyframes[0]
    other = first.T_world_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    with pytest.raises(UsageError, match="where up is"):
        make_occupancy_grid(replace(version, keyframes=(first, replace(first, id=1, T_world_camera=other))))
    with pytest.raises(UsageError, match="within 30 m of a pose"):
        make_occupancy_grid(replace(version, points=version.points + np.float32(1000.0)), UP)
