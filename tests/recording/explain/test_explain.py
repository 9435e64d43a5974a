"""Causes of bad poses: each planted in a generated command, and input that a stranger may have made."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform
from rse_pf.pnp import PnpOptions, PnpSolution, solve_pnp
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem
from rse_pf.recording.explain import Cause, PastCommand, PoseExplanation, Timing, explain
from rse_pf.services.pnp import PnpReply, make_request

N = 200
OPTIONS = PnpOptions(inlier_px=3.0)
ON_TIME = Timing(
    frame_s=10.0, sent_s=10.02, answered_s=10.05, received_s=3.0, replied_s=3.01, period_s=0.2, deadline_s=0.2
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Payload:
    """Matches in the shape of a request."""

    points_world: Array
    pixels: Array
    camera: Camera = KINECT
    options: PnpOptions | None = OPTIONS
    depths_m: Array | None = None


def payload(seed: int = 1, *, outliers: float = 0.05) -> Payload:
    """Return a healthy command: a room, 0.7 px of noise."""
    problem = make_problem(seed=seed, n=N, noise_px=0.7, outlier_ratio=outliers)
    return Payload(points_world=problem.points_world, pixels=problem.pixels)


def reply_to(command: Payload) -> PnpSolution | None:
    """Return the service's answer, None where it refuses."""
    try:
        return solve_pnp(command.points_world, command.pixels, command.camera, command.options)
    except RsePfError:
        return None


def explained(command: Payload, **recorded: Any) -> list[PoseExplanation]:
    """Return the explanations of a command with the reply that the service gives."""
    return explain(command, reply_to(command), **recorded)


def first(command: Payload, **recorded: Any) -> Cause:
    """Return the likeliest cause."""
    return explained(command, **recorded)[0].cause


def test_says_that_nothing_is_wrong_with_a_healthy_command() -> None:
    for seed in range(5):
        found = explained(payload(seed), timing=ON_TIME)

        assert [each.cause for each in found] == [Cause.NONE]


def test_takes_requests_and_replies_as_they_are_on_the_wire() -> None:
    command = payload()
    request = make_request(command.points_world, command.pixels, command.camera, binary=True)
    solution = reply_to(command)
    assert solution is not None

    assert explain(request, PnpReply.of(solution))[0].cause is Cause.NONE


def test_names_the_evidence_that_was_not_recorded() -> None:
    missing = explained(payload())[0].missing

    assert [each.split(" (")[0] for each in missing] == [
        "times", "thumbnail", "earlier commands of the robot",
    ]  # fmt: skip


def test_nothing_is_missing_where_all_was_recorded() -> None:
    past, T_odom_camera, command = moving_robot(scale=1.0)

    found = explained(command, timing=ON_TIME, thumbnail=picture(), history=past, T_odom_camera=T_odom_camera)

    assert (found[0].cause, found[0].missing) == (Cause.NONE, ())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_names_a_mirrored_world(axis: int) -> None:
    command = payload()
    signs = np.ones(3)
    signs[axis] = -1.0

    assert first(replace(command, points_world=command.points_world * signs)) is Cause.MIRRORED


@pytest.mark.parametrize("factor", [0.75, 1.12, 2.0])
def test_names_a_wrong_focal_length_and_tells_the_right_one(factor: float) -> None:
    wrong = Camera(
        fx=KINECT.fx * factor, fy=KINECT.fy * factor, cx=KINECT.cx, cy=KINECT.cy, width=640, height=480
    )

    found = explained(replace(payload(), camera=wrong))[0]

    assert found.cause is Cause.INTRINSICS
    assert found.evidence["focal_factor"] == pytest.approx(1.0 / factor, rel=0.02)


@pytest.mark.parametrize("order", ["shifted", "reversed", "second half shifted"])
def test_names_rows_that_are_out_of_step(order: str) -> None:
    command = payload()
    rows = np.arange(N)
    rows = {
        "shifted": np.roll(rows, 2),
        "reversed": rows[::-1],
        "second half shifted": np.concatenate([rows[: N // 2], np.roll(rows[N // 2 :], 1)]),
    }[order]

    assert first(replace(command, pixels=command.pixels[rows])) is Cause.ROW_ORDER


def test_names_shuffled_rows_where_the_past_tells_about_where_the_camera_is() -> None:
    problem = make_problem(seed=3, n=N, noise_px=0.7, outlier_ratio=0.0)
    order = np.random.default_rng(0).permutation(N)
    shuffled = Payload(points_world=problem.points_world, pixels=problem.pixels[order])
    near = exp_se3([0.03, 0.0, 0.02, 0.0, 0.03, 0.0]) @ problem.T_camera_world

    found = explained(shuffled, history=[PastCommand(sent_s=1.0, T_camera_world=near)])

    assert found[0].cause is Cause.ROW_ORDER


@pytest.mark.parametrize("share", [0.6, 0.7, 0.85])
def test_names_wrong_matches_where_most_are(share: float) -> None:
    found = explained(payload(outliers=share))[0]

    assert found.cause is Cause.OUTLIERS
    assert found.evidence["outlier_share"] == pytest.approx(share, abs=0.05)


def test_names_copies_of_a_few_matches() -> None:
    command = payload()
    rows = np.concatenate([np.arange(40), np.random.default_rng(0).integers(0, 8, N - 40)])

    found = explained(
        Payload(points_world=command.points_world[rows], pixels=command.pixels[rows])
    )[0]  # fmt: skip

    assert found.cause is Cause.DUPLICATES
    assert found.evidence["distinct"] == 40


@pytest.mark.parametrize("kind", ["collinear", "coincident", "same-pixel", "line-of-sight"])
def test_names_points_that_fix_no_pose(kind: str) -> None:
    problem = make_degenerate(kind, seed=1, n=60)

    assert first(Payload(points_world=problem.points_world, pixels=problem.pixels)) is Cause.PLANE


def test_names_a_far_plane_and_not_a_near_one() -> None:
    causes = [first(wall(distance_m, half_px)) for distance_m, half_px in ((4.0, 45.0), (1.5, 220.0))]

    assert causes == [Cause.PLANE, Cause.NONE]


def wall(distance_m: float, half_px: float) -> Payload:
    """Return features on a wall, all within *half_px* of the centre of the image."""
    rng = np.random.default_rng(2)
    pixels = np.array([320.0, 240.0]) + rng.uniform(-1, 1, (80, 2)) * half_px
    rays = KINECT.back_project(pixels, np.ones(80))
    points = rays * (distance_m / (rays @ [0.25, 0.1, 1.0]))[:, None]
    return Payload(
        points_world=points + rng.normal(size=points.shape) * 0.004,
        pixels=pixels + rng.normal(size=pixels.shape) * 0.7,
    )


def test_names_a_map_of_which_a_part_moved_and_tells_how_far() -> None:
    command = payload()
    points = command.points_world.copy()
    moved = np.argsort(points[:, 0])[: N * 3 // 10]
    points[moved] += [0.0, 0.3, 0.1]

    found = explained(replace(command, points_world=points))[0]

    assert found.cause is Cause.STALE_MAP
    assert found.evidence["moved_m"] == pytest.approx(0.316, abs=0.03)


def moving_robot(*, scale: float) -> tuple[list[PastCommand], Array, Payload]:
    """Return the past of a robot, its odometry and a command, with the map *scale* times too large."""
    rng = np.random.default_rng(4)
    problem = make_problem(seed=5, n=N, noise_px=0.5, outlier_ratio=0.05)
    T_world_camera, T_odom_camera = inverse(problem.T_camera_world), np.eye(4)
    step = exp_se3([0.02, 0.0, 0.1, 0.0, 0.02, 0.0])
    past: list[PastCommand] = []
    for k in range(5):  # backwards in time from the command
        T_world_camera, T_odom_camera = T_world_camera @ inverse(step), T_odom_camera @ inverse(step)
        pose = inverse(T_world_camera)
        pose[:3, 3] = pose[:3, 3] * scale + rng.normal(size=3) * 0.003
        past.append(PastCommand(
            sent_s=9.8 - 0.2 * k, T_camera_world=pose, T_odom_camera=T_odom_camera, matches=N,
            thumbnail=picture(),
        ))  # fmt: skip
    command = Payload(points_world=problem.points_world * scale, pixels=problem.pixels)
    return past[::-1], np.eye(4), command


@pytest.mark.parametrize("scale", [0.5, 1.25])
def test_names_a_wrong_depth_scale_by_the_odometry(scale: float) -> None:
    past, T_odom_camera, command = moving_robot(scale=scale)

    found = explained(command, history=past, T_odom_camera=T_odom_camera)[0]

    assert found.cause is Cause.DEPTH_SCALE
    assert found.evidence["scale"] == pytest.approx(scale, rel=0.06)


def test_names_a_depth_scale_that_differs_between_two_images() -> None:
    problem = make_problem(seed=6, n=N, noise_px=0.5, outlier_ratio=0.05)
    depths = transform(problem.T_camera_world, problem.points_world)[:, 2]

    causes = [
        first(Payload(points_world=problem.points_world, pixels=problem.pixels, depths_m=factor * depths))
        for factor in (1.0, 1.2)
    ]

    assert causes == [Cause.NONE, Cause.DEPTH_SCALE]


def picture(blurred_px: int = 0, *, brightness: float = 1.0) -> bytes:
    """Return a thumbnail of noise of all sizes, blurred along its rows."""
    from PIL import Image

    rng = np.random.default_rng(7)
    image = sum(
        np.kron(rng.normal(size=(120 // size, 160 // size)), np.ones((size, size))) * size**0.5
        for size in (1, 2, 4, 8)
    )
    assert isinstance(image, np.ndarray)
    if blurred_px:
        image = np.mean([np.roll(image, shift, axis=1) for shift in range(blurred_px)], axis=0)
    stream = io.BytesIO()
    gray: Any = np.clip(brightness * (110 + 12 * image), 0, 255).astype(np.uint8)
    Image.fromarray(gray).save(stream, "JPEG", quality=80)
    return stream.getvalue()


def test_names_blur_along_a_direction_but_not_darkness() -> None:
    past = [PastCommand(sent_s=float(k), thumbnail=picture()) for k in range(4)]

    blurred, dark = (
        explained(payload(), thumbnail=thumbnail, history=past)[0]
        for thumbnail in (picture(3), picture(brightness=0.5))
    )

    assert (blurred.cause, dark.cause) == (Cause.BLUR, Cause.NONE)
    assert "along the horizontal direction" in blurred.sentence


@pytest.mark.parametrize(
    "late",
    [{"answered_s": 10.6}, {"frame_s": 9.4}, {"frame_s": 10.5}],
    ids=["answer", "frame", "stamp in the future"],
)
def test_names_what_came_late(late: dict[str, float]) -> None:
    assert first(payload(), timing=replace(ON_TIME, **late)) is Cause.LATE


@pytest.mark.parametrize("kind", DEGENERATE)
def test_explains_any_input_with_finite_numbers(kind: str) -> None:
    problem = make_degenerate(kind, seed=2, n=24)
    hostile = PnpSolution(
        T_camera_world=np.full((4, 4), np.nan), inliers=np.array([-3, 10**9]), rmse_px=float("nan"),
        covariance=np.eye(6), verdict="ok", reason="", engine="",
    )  # fmt: skip
    history = [PastCommand(sent_s=np.inf, T_camera_world=np.zeros((4, 4)), thumbnail=b"no picture")]

    found = explain(
        Payload(points_world=problem.points_world, pixels=problem.pixels, depths_m=np.full(24, np.nan)),
        hostile, thumbnail=b"\x89PNG", history=history, T_odom_camera=np.eye(3),
        timing=Timing(frame_s=np.nan, sent_s=np.inf, answered_s=1e300, period_s=0.0, deadline_s=-1.0),
    )  # fmt: skip

    assert found
    assert all(0.0 <= each.confidence <= 1.0 for each in found)
    assert np.isfinite([number for each in found for number in each.evidence.values()]).all()


def test_judges_a_long_command_by_rows_from_all_of_it() -> None:
    problem = make_problem(seed=1, n=3000, noise_px=0.7, outlier_ratio=0.05)
    command = Payload(points_world=problem.points_world, pixels=np.roll(problem.pixels, 1, axis=0))

    found = explain(command, None)[0]

    assert (found.cause, found.evidence["row_shift"]) == (Cause.ROW_ORDER, 1.0)


def test_says_so_where_too_few_rows_are_usable() -> None:
    found = explain(Payload(points_world=np.ones((3, 3)), pixels=np.ones((3, 2))), None)[0]

    assert (found.cause, found.evidence["matches"]) == (Cause.UNKNOWN, 3.0)


def test_the_same_command_gets_the_same_explanation() -> None:
    command = payload(outliers=0.7)

    assert [each.sentence for each in explained(command)] == [each.sentence for each in explained(command)]


def test_does_not_take_older_keyframes_for_a_depth_scale() -> None:
    step = exp_se3([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    odometry = [exp_se3([0.0, 0.0, 0.1 * k, 0.0, 0.0, 0.0]) for k in range(10)]
    pixels = payload().pixels
    points = KINECT.back_project(pixels, np.random.default_rng(1).uniform(1.0, 5.0, N))

    causes = []
    for frames_back in ([1, 2, 3] * 3, [2] * 9):  # a keyframe that grows old, and a scale of 2
        poses = [np.linalg.matrix_power(inverse(step), back) for back in frames_back]
        past = [PastCommand(sent_s=0.0, T_odom_camera=odometry[0])]
        past += [
            PastCommand(sent_s=0.1 * k, T_camera_world=poses[k - 1], T_odom_camera=odometry[k])
            for k in range(1, 9)
        ]
        seen = KINECT.project(transform(poses[-1], points))
        command = Payload(points_world=points, pixels=seen)
        causes.append(first(command, history=past, T_odom_camera=odometry[9]))

    assert causes == [Cause.NONE, Cause.DEPTH_SCALE]
