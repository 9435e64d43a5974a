"""A user's features: what a function may return, what is refused, and that a mapper tracks with them."""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import FrontEndOptions, PoseQuery, TrackedFrame, describe
from client_sdk.mapper import Mapper
from client_sdk.monocular.bundle import Bundle, adjust
from client_sdk.plugins import (
    FeaturesPlugin,
    FoundFeatures,
    LoopsPlugin,
    OptimiserPlugin,
    load_features,
    load_function,
)
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, exp_se3
from rse_pf.maps.descriptors import ORB
from rse_pf.maps.format import decode_map
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import STEP_M, frame_at, tracked

IMAGE: npt.NDArray[np.uint8] = np.zeros((480, 640, 3), dtype=np.uint8)


def found(n: int = 6, **other: Any) -> FoundFeatures:
    rng = np.random.default_rng(n)
    fields: dict[str, Any] = {
        "pixels": rng.uniform(0, 400, (n, 2)), "scores": rng.uniform(0, 1, n),
        "descriptors": rng.standard_normal((n, 64)).astype(np.float32), **other,
    }  # fmt: skip
    return FoundFeatures(**fields)


def plugin_of(result: Any, name: str = "mine") -> FeaturesPlugin:
    def function(_: npt.NDArray[np.uint8]) -> Any:
        return result

    function.__name__ = name
    return FeaturesPlugin(function)


def orb_by_hand(rgb: npt.NDArray[np.uint8]) -> FoundFeatures:
    import cv2

    points, descriptors = cv2.ORB_create(1500).detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    return FoundFeatures(
        pixels=cv2.KeyPoint_convert(points), scores=[p.response for p in points], descriptors=descriptors,
        orientations_deg=[p.angle for p in points], sizes=[1.2**p.octave for p in points],
    )  # fmt: skip


def sift(rgb: npt.NDArray[np.uint8]) -> FoundFeatures:
    import cv2

    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    points, descriptors = cv2.SIFT_create(1500).detectAndCompute(gray, None)
    return FoundFeatures(
        pixels=cv2.KeyPoint_convert(points), scores=[p.response for p in points], descriptors=descriptors
    )


HOSTILE: dict[str, tuple[Any, str]] = {
    "nothing": (None, "returned NoneType, not FoundFeatures"),
    "a tuple": ((1, 2, 3), "returned tuple"),
    "pixels of three numbers": (found(pixels=np.ones((6, 3))), r"pixels of shape \(6, 3\), not \(n, 2\)"),
    "flat pixels": (found(pixels=np.ones(12)), "pixels of shape"),
    "pixels that are text": (found(pixels=[["a", "b"]] * 6), "pixels that are no numbers"),
    "pixels that are not finite": (found(pixels=np.full((6, 2), np.nan)), "pixels that are not finite"),
    "pixels outside": (found(pixels=np.full((6, 2), 640.0)), "6 pixels outside the image"),
    "negative pixels": (found(pixels=np.full((6, 2), -1.0)), "6 pixels outside the image"),
    "ragged pixels": (found(pixels=[[1, 2], [3]]), "pixels that are no numbers"),
    "too many": (found(pixels=np.ones((100_001, 2))), "100001 features, above"),
    "too few scores": (found(scores=np.ones(5)), r"scores of shape \(5,\), not \(6,\)"),
    "scores that are not finite": (found(scores=[np.inf] * 6), "scores that are not finite"),
    "no descriptors": (found(descriptors=None), r"descriptors of shape \(\)"),
    "too few descriptors": (found(descriptors=np.ones((5, 64))), r"descriptors of shape \(5, 64\) for 6"),
    "huge descriptors": (found(descriptors=np.ones((6, 100_000))), r"descriptors of shape \(6, 100000\)"),
    "tiny descriptors": (found(descriptors=np.ones((6, 1))), r"descriptors of shape \(6, 1\)"),
    "integers": (found(descriptors=np.ones((6, 64), dtype=np.int32)), "descriptors of int32"),
    "text": (found(descriptors=np.full((6, 64), "a")), "descriptors of <U1"),
    "NaN": (found(descriptors=np.full((6, 64), np.nan)), "descriptors that are not finite"),
    "infinite": (found(descriptors=np.full((6, 64), np.inf)), "descriptors that are not finite"),
    "zero": (found(descriptors=np.zeros((6, 64))), "not finite, or zero"),
    "orientations of another number": (found(orientations_deg=[0.0]), "orientations_deg of shape"),
    "orientations that are not finite": (
        found(orientations_deg=[np.nan] * 6),
        "orientations_deg that are not",
    ),
    "sizes of zero": (found(sizes=np.zeros(6)), "sizes that are not above 0"),
}


@pytest.mark.parametrize(("result", "why"), HOSTILE.values(), ids=HOSTILE)
def test_what_cannot_be_features_is_refused_in_one_line(result: Any, why: str) -> None:
    with pytest.raises(UsageError, match=f"the features function mine {why}|{why}") as refused:
        plugin_of(result)(IMAGE)
    assert refused.value.hint
    assert "\n" not in refused.value.message


def test_a_function_that_fails_is_named_with_its_error() -> None:
    def broken(_: npt.NDArray[np.uint8]) -> FoundFeatures:
        raise ZeroDivisionError("by\nzero")

    where = r"by zero \(test_plugins.py, line \d+\)"
    with pytest.raises(UsageError, match=f"broken failed: ZeroDivisionError: {where}") as refused:
        FeaturesPlugin(broken)(IMAGE)
    assert "\n" not in refused.value.message
    assert isinstance(refused.value.__cause__, ZeroDivisionError)


def test_the_kind_of_features_must_not_change_during_a_drive() -> None:
    results = [found(), found(0, descriptors=None), found(descriptors=np.ones((6, 32), np.uint8))]

    def changing(_: npt.NDArray[np.uint8]) -> FoundFeatures:
        return results.pop(0)

    plugin = FeaturesPlugin(changing)
    plugin(IMAGE)
    assert len(plugin(IMAGE).pixels) == 0
    with pytest.raises(UsageError, match=r"returned changing \(32 bytes\) after changing \(64 dimensions\)"):
        plugin(IMAGE)


@pytest.mark.parametrize("name", ["<lambda>", "a b", "x" * 33, "orb", "ORB"])
def test_a_function_needs_a_name_that_features_can_have(name: str) -> None:
    with pytest.raises(UsageError, match="name"):
        plugin_of(found(), name)
    with pytest.raises(UsageError, match="takes a function, not a int"):
        FeaturesPlugin(3)  # type: ignore[arg-type]


def test_features_are_spread_and_the_strongest_are_kept() -> None:
    pixels = np.concatenate([np.full((50, 2), 10.0), [[500.0, 300.0]]])
    plugin = plugin_of(
        found(51, pixels=pixels, scores=np.linspace(1.0, 0.1, 51), descriptors=np.ones((51, 8), np.uint8))
    )

    spread = describe(IMAGE, 10, plugin=plugin)
    strongest = describe(IMAGE, 10, is_spread=False, plugin=plugin)

    assert len(spread.pixels) == len(strongest.pixels) == 10
    assert [500.0, 300.0] in spread.pixels.tolist()
    assert [500.0, 300.0] not in strongest.pixels.tolist()
    assert spread.kind == plugin.kind


@pytest.mark.parametrize("function", [orb_by_hand, sift])
@pytest.mark.parametrize("depth", [True, False])
async def test_a_mapper_tracks_with_the_features_of_its_user(function: Any, depth: bool) -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    mapper = Mapper(ask=solve, features=function, keyframes_of="robot-1" if depth else "")

    statuses = [(await mapper.track(frame_at(row, depth=depth))).status for row in range(8 if depth else 18)]

    assert statuses.count("tracked") >= 6, statuses
    positions = mapper.trajectory.positions
    if depth:
        assert positions[:, 0] == pytest.approx(STEP_M * np.arange(8), abs=0.01)
        assert decode_map(mapper.encoded_map()).kind.name == function.__name__
    assert len(mapper.map) > 100


def test_orb_by_hand_is_tracked_as_well_as_the_built_in_one() -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    options = FrontEndOptions(is_spread=False)

    def errors(features: Any) -> float:
        mapper = Mapper(ask=solve, options=options, features=features)
        played(mapper, list(range(8)))
        return float(np.abs(mapper.trajectory.positions[:, 0] - STEP_M * np.arange(8)).max())

    assert errors(orb_by_hand) < 2.0 * errors(None) + 1e-3
    assert ORB.name != "orb_by_hand"


# --- motion, places and the optimiser ----------------------------------------------------------


def played(mapper: Mapper, rows: list[int], *, depth: bool = True) -> list[TrackedFrame]:
    return tracked(mapper, (frame_at(row, depth=depth) for row in rows))


@pytest.mark.parametrize("depth", [True, False])
def test_a_motion_function_gets_the_newest_poses_and_its_pose_is_used(depth: bool) -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    asked: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]] = []

    def motion(
        stamps_s: npt.NDArray[np.float64], poses: npt.NDArray[np.float64], stamp_s: float
    ) -> npt.NDArray[np.float64]:
        asked.append((stamps_s, poses, stamp_s))
        return poses[-1]

    mapper = Mapper(ask=solve, motion=motion)
    done = played(mapper, list(range(16)), depth=depth)

    assert len(asked) >= 5
    for stamps_s, poses, stamp_s in asked:
        assert 1 <= len(stamps_s) == len(poses) <= 10
        assert (np.diff(stamps_s) > 0).all()
        assert stamps_s[-1] < stamp_s
    stamps = [each.frame.timestamp_s for each in done]
    assert asked[-1][2] == stamps[-1]
    last = done[-2].T_world_camera
    assert last is not None
    if depth:
        assert np.allclose(asked[-1][1][-1], last)


def test_a_motion_function_that_is_far_off_costs_the_guided_match_only() -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    kinds = Counter[str]()

    async def ask(query: PoseQuery) -> PoseAnswer:
        kinds[query.against] += 1
        return await solve(query)

    def motion(_: Any, poses: npt.NDArray[np.float64], __: float) -> npt.NDArray[np.float64]:
        turned: npt.NDArray[np.float64] = poses[-1] @ exp_se3([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])
        return turned

    done = played(Mapper(ask=ask, motion=motion), list(range(6)))

    assert [each.status for each in done] == ["first", *["tracked"] * 5]
    assert kinds["frame"] >= 5
    assert kinds["map"] == 0


@pytest.mark.parametrize(
    ("returned", "why"),
    [
        (None, "poses of shape"),
        (np.eye(3), r"poses of shape \(3, 3\)"),
        (np.full((4, 4), np.nan), "poses that are not finite"),
        (2 * np.eye(4), "a matrix that is no pose"),
        ("text", "no numbers"),
    ],
)
def test_what_is_no_pose_is_refused_and_the_next_frame_is_tracked(returned: Any, why: str) -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    results = [returned, *[None] * 9]

    def motion(_: Any, poses: npt.NDArray[np.float64], __: float) -> Any:
        first = results.pop(0)
        return first if len(results) == 9 else poses[-1]

    mapper = Mapper(ask=solve, motion=motion)
    played(mapper, [0])
    with pytest.raises(UsageError, match=why) as refused:
        played(mapper, [1])
    assert refused.value.hint
    assert "\n" not in refused.value.message
    assert played(mapper, [2])[0].status == "tracked"


@pytest.mark.parametrize("depth", [True, False])
def test_a_loops_function_says_which_keyframes_are_tried(depth: bool) -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    seen: list[tuple[int, ...]] = []

    def mean_colours(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
        seen.append(rgb.shape)
        return rgb.reshape(-1, 3).mean(axis=0).repeat(4) + 1.0

    mapper = Mapper(ask=solve, loops=mean_colours)
    played(mapper, list(range(14)), depth=depth)

    assert seen
    assert len(seen) <= mapper.keyframes + 1
    assert set(seen) == {frame_at(0, depth=True).rgb.shape}


@pytest.mark.parametrize(
    ("returned", "why"),
    [
        (np.zeros(64), "64 numbers with a norm of 0"),
        (np.ones(7), "7 numbers"),
        (np.ones(4097), "4097 numbers"),
        (np.ones((8, 8)), r"shape \(8, 8\)"),
        (np.full(64, np.inf), "not finite"),
    ],
)
def test_an_invalid_place_vector_is_refused(returned: Any, why: str) -> None:
    with pytest.raises(UsageError, match=why) as refused:
        LoopsPlugin(lambda _: returned)(IMAGE)
    assert "\n" not in refused.value.message
    sizes = [64, 65]
    changing = LoopsPlugin(lambda _: np.ones(sizes.pop(0)))
    assert float(np.linalg.norm(changing(IMAGE))) == pytest.approx(1.0)
    with pytest.raises(UsageError, match="65 numbers"):
        changing(IMAGE)


def test_an_optimiser_adjusts_a_camera_without_depth() -> None:
    pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
    sizes: list[int] = []

    def own(bundle: Bundle, camera: Camera, iterations: int) -> tuple[Any, Any]:
        sizes.append(len(bundle.pixels))
        return adjust(bundle, camera, iterations=iterations)

    with_own, built_in = Mapper(ask=solve, optimiser=own), Mapper(ask=solve)
    for mapper in (with_own, built_in):
        played(mapper, list(range(16)), depth=False)

    assert sizes
    assert np.allclose(with_own.trajectory.positions, built_in.trajectory.positions)


@pytest.mark.parametrize(
    ("returned", "why"),
    [
        (None, "NoneType, not poses and points"),
        ((np.zeros((3, 4, 4)),), "not poses and points"),
        ((np.zeros((3, 4, 4)), np.zeros((5, 3))), "a matrix that is no pose"),
        ((np.tile(np.eye(4), (2, 1, 1)), np.zeros((5, 3))), r"shape \(2, 4, 4\)"),
        ((np.tile(np.eye(4), (3, 1, 1)), np.full((5, 3), np.nan)), "not finite"),
    ],
)
def test_an_optimiser_must_return_all_poses_and_points(returned: Any, why: str) -> None:
    bundle = Bundle(
        T_camera_world=np.tile(np.eye(4), (3, 1, 1)), is_fixed=np.ones(3, dtype=bool),
        points_world=np.zeros((5, 3)), cameras=np.zeros(0, np.int64), points=np.zeros(0, np.int64),
        pixels=np.zeros((0, 2)), sigma_px=np.zeros(0),
    )  # fmt: skip
    with pytest.raises(UsageError, match=why) as refused:
        OptimiserPlugin(lambda *_: returned)(bundle, frame_at(0, depth=True).camera)
    assert "\n" not in refused.value.message


# --- names on the command line -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("sift", "names no function"),
        ("a b:c", "names no function"),
        (":c", "names no function"),
        ("nowhere_at_all:f", "ModuleNotFoundError: No module named 'nowhere_at_all'\n"),
        ("json:nothing", "json has no function nothing"),
        ("broken_module:f", "cannot be loaded: SyntaxError"),
        ("json:__name__", "takes a function, not a str"),
    ],
)
def test_what_names_no_function_is_refused_in_one_line(
    name: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_module.py").write_text("def f(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(UsageError, match=why) as refused:
        load_features(name)
    assert refused.value.hint
    assert "\n" not in refused.value.message
    assert "importlib" not in refused.value.message
    assert callable(load_function("json:dumps"))


@pytest.mark.parametrize("error", [asyncio.CancelledError(), SystemExit(3), StopIteration()])
def test_a_function_that_raises_what_would_end_a_task_or_a_thread_is_named(error):
    def features(rgb):
        raise error

    with pytest.raises(UsageError, match="the features function features failed"):
        FeaturesPlugin(features)(np.zeros((48, 64, 3), np.uint8))
