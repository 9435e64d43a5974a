"""Place recognition and localisation in a map; a prior position only narrows the search."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.maps.descriptors import Descriptors
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.mapping.localise import LocaliseOptions, LocaliseReply, LocaliseRequest, locate
from rse_pf.services.mapping.place import MapIndex, PlaceReply, PlaceRequest, Within
from rse_pf.slam.descriptors import best_matches
from rse_pf.slam.relative_pose import View
from rse_pf.wire import Command, Failure, Result
from tests.kit.synthetic_maps import make_world

WORLD = make_world(1)
TURNS = np.linspace(0.0, 1.0, 24, endpoint=False)


def true_map() -> MapVersion:
    """Return a map of the whole hall with true poses."""
    rng = np.random.default_rng(5)
    poses = [WORLD.pose(turn) for turn in TURNS]
    return MapVersion(keyframes=tuple(WORLD.keyframe(n, "map", T, T, rng) for n, T in enumerate(poses)))


MAP = true_map()
INDEX = MapIndex(MAP.keyframes)


def seen(turn: float, seed: int = 9) -> tuple[Keyframe, Array]:
    """Return a keyframe between those of the map, and its true pose."""
    truth = WORLD.pose(turn)
    return WORLD.keyframe(0, "r", truth, np.eye(4), np.random.default_rng(seed)), truth


def view(keyframe: Keyframe) -> View:
    """Return the pixels and descriptors of a keyframe as a view without depths."""
    return View(
        camera=keyframe.camera, pixels=keyframe.pixels.astype(np.float64), descriptors=keyframe.descriptors
    )


@pytest.mark.parametrize("turn", [0.02, 0.31, 0.55, 0.98])
def test_a_view_of_the_hall_is_located_where_it_was_taken(turn: float) -> None:
    keyframe, truth = seen(turn)

    found = locate(INDEX, view(keyframe))

    assert found.verdict == "ok", found.reason
    assert found.T_map_camera is not None
    metres, degrees = pose_difference(found.T_map_camera, truth)
    assert metres <= 0.03
    assert degrees <= 0.5


@pytest.mark.parametrize("turn", [0.02, 0.31, 0.55])
def test_the_best_candidate_is_a_neighbour(turn: float) -> None:
    ((row, score), *_) = INDEX.nearest(seen(turn)[0].descriptors, 3)

    apart = abs(TURNS[row] - turn)
    assert min(apart, 1.0 - apart) <= 2 / 24
    assert 0 < score <= 1


def test_a_view_of_another_hall_is_lost_and_not_guessed() -> None:
    elsewhere = make_world(2)
    keyframe = elsewhere.keyframe(0, "r", elsewhere.pose(0.3), np.eye(4), np.random.default_rng(1))

    found = locate(INDEX, view(keyframe))

    assert found.verdict == "lost"
    assert found.T_map_camera is None


def test_a_view_of_two_halls_that_look_alike_is_weak() -> None:
    far = np.eye(4)
    far[0, 3] = 50.0
    rng = np.random.default_rng(6)
    copies = [
        WORLD.keyframe(100 + number, "map", WORLD.pose(turn), far @ WORLD.pose(turn), rng)
        for number, turn in enumerate(TURNS)
    ]

    found = locate(MapIndex([*MAP.keyframes, *copies]), view(seen(0.31)[0]), LocaliseOptions(candidates=12))

    assert (found.verdict, found.reason) == ("weak", "ambiguous")


def test_a_prior_narrows_the_search_and_a_wrong_one_finds_nothing() -> None:
    keyframe, truth = seen(0.31)
    x, y, z = truth[:3, 3].tolist()

    near = locate(INDEX, view(keyframe), within=Within(x=x, y=y, z=z, radius_m=0.8))
    nowhere = locate(INDEX, view(keyframe), within=Within(x=90.0, y=0.0, z=0.0, radius_m=1.0))

    assert near.verdict == "ok"
    assert (nowhere.verdict, nowhere.reason) == ("lost", "no-candidates")


def wall_view(factor: float, slope: float, seed: int) -> tuple[MapIndex, View, Array]:
    """Return a map of a wall at 4 m with 5 cm relief, a view of the wall, and the true pose of the view.

    Args:
        factor: Stated over true focal length of the view.
        slope: Tangent of the angle by which the wall is rotated.
        seed: Of the random points.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.4, -1.8, 3.95], [2.4, 1.8, 4.05], (300, 3))
    points[:, 2] += slope * points[:, 0]
    descriptors = rng.integers(0, 256, (300, 32), dtype=np.uint8)

    def seen_from(T_map_camera: Array) -> tuple[Array, Array, Descriptors]:
        inside = transform(inverse(T_map_camera), points)
        pixels = 525.0 * inside[:, :2] / inside[:, 2:] + [319.5, 239.5] + rng.normal(0.0, 1.0, (300, 2))
        depths_m = inside[:, 2] + rng.normal(0.0, 0.023, 300)  # a Kinect's noise at 4 m
        rays = np.column_stack([(pixels - [319.5, 239.5]) / 525.0, np.ones(300)])
        is_seen = ((pixels > 0.0) & (pixels < [640.0, 480.0])).all(axis=1)
        return pixels[is_seen], (rays * depths_m[:, None])[is_seen], descriptors[is_seen]

    camera = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
    keyframes = []
    for number in range(4):
        T = exp_se3(np.array([0.15 * number - 0.2, 0.05 * number, 0.0, 0.0, 0.0, 0.0]))
        pixels, points_camera, described = seen_from(T)
        keyframes.append(
            Keyframe(
                id=number,
                robot="map",
                timestamp_s=float(number),
                camera=camera,
                T_world_camera=T,
                pixels=pixels.astype(np.float32),
                descriptors=described,
                points_camera=points_camera.astype(np.float32),
            )
        )
    truth = exp_se3(np.array([0.1, 0.05, 0.3, 0.02, 0.03, 0.01]))
    pixels, _, described = seen_from(truth)
    stated = Camera(fx=525.0 * factor, fy=525.0 * factor, cx=319.5, cy=239.5, width=640, height=480)
    return MapIndex(keyframes), View(camera=stated, pixels=pixels, descriptors=described), truth


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("slope", [0.0, 0.36, 0.84])
@pytest.mark.parametrize("factor", [0.9, 0.95, 1.0, 1.05, 1.1])
def test_before_a_flat_wall_which_hides_the_focal_length_a_pose_knows_its_error(
    factor: float, slope: float, seed: int
) -> None:
    index, view_of_wall, truth = wall_view(factor, slope, seed)

    found = locate(index, view_of_wall)

    assert factor != 1.0 or found.verdict == "ok", found.reason
    if found.verdict == "ok":
        assert found.T_map_camera is not None
        assert found.covariance is not None
        metres, _ = pose_difference(found.T_map_camera, truth)
        sigma_m = float(np.sqrt(np.trace(found.covariance[:3, :3])))
        assert metres <= max(0.05, 3.0 * sigma_m)


def test_matches_are_closest_and_unambiguous_and_used_once() -> None:
    rng = np.random.default_rng(3)
    reference = rng.integers(0, 256, (50, 32), dtype=np.uint8)
    order = rng.permutation(50)
    other = reference[order].copy()
    other[:, 0] ^= 1

    rows, columns = best_matches(np.concatenate([reference, reference[:5]]), other, 0.75)

    assert len(columns) == len(set(columns.tolist())) == 50
    np.testing.assert_array_equal(order[columns], rows % 50)


def request_of(keyframe: Keyframe, kind: type[PlaceRequest] | type[LocaliseRequest], **more: object):  # type: ignore[no-untyped-def]
    """Return the request by which a robot asks where *keyframe* is."""
    return kind(
        map=encode_map(MAP),
        camera=keyframe.camera,
        pixels=keyframe.pixels.ravel().astype(np.float64),
        descriptors=keyframe.descriptors.tobytes(),
        **more,  # type: ignore[arg-type]
    )


def ask(service: str, request: object) -> Result | Failure:
    """Send *request* through a server's dispatch."""
    registry = builtin_services(PlatformSettings())
    return dispatch(registry, Command(id=1, service=service, payload=request), lambda: 0.0)


def test_the_services_answer_encoded_requests() -> None:
    keyframe, truth = seen(0.31)

    place = ask("place", request_of(keyframe, PlaceRequest))
    location = ask("localise", request_of(keyframe, LocaliseRequest))

    assert isinstance(place, Result), place
    assert isinstance(place.reply, PlaceReply)
    counts = [each.inliers or 0 for each in place.reply.candidates]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] >= 30
    assert isinstance(location, Result), location
    assert isinstance(location.reply, LocaliseReply)
    assert location.reply.T_map_camera is not None
    assert pose_difference(location.reply.T_map_camera.reshape(4, 4), truth)[0] <= 0.03
