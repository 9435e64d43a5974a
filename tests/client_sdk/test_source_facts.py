"""The gate before tracking: facts that contradict each other are refused, unlikely ones are named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from client_sdk.source_facts import (
    CameraFacts,
    DepthFacts,
    SourceFacts,
    TimeFacts,
    VideoFacts,
    check_accepted,
    check_source,
    rows_in_time,
    time_unit_s,
    unresolved,
)
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, Lens


def camera(size: tuple[int, int] = (640, 480), **facts: Any) -> dict[str, Any]:
    numbers = {name: facts.pop(name, value) for name, value in {"fx": 525.0, "cx": 319.5}.items()}
    lens = Lens(
        camera=Camera(fy=numbers["fx"], cy=239.5, width=size[0], height=size[1], **numbers),
        model=facts.pop("model", "radial-tangential"),
    )
    return {"cameras": (CameraFacts(stated_by="intrinsics.json", lens=lens, **facts),)}


def depth(median_m: float | None, *, is_unit_stated: bool = True) -> dict[str, Any]:
    return {"depth": DepthFacts(median_m=median_m, units_per_m=1000.0, is_unit_stated=is_unit_stated)}


def times(*stamps_s: float) -> TimeFacts:
    return TimeFacts(stated_by="rgb.txt", stamps_s=np.array(stamps_s))


def source(**facts: Any) -> SourceFacts:
    return SourceFacts(name="drive", **facts)


def videos(left: tuple[int, float], right: tuple[int, float]) -> dict[str, Any]:
    """Return facts on two videos by their numbers of images and the times between these."""
    pair = {"left.avi": left, "right.avi": right}
    return {"videos": {name: VideoFacts(frames=n, period_s=s) for name, (n, s) in pair.items()}}


@pytest.mark.parametrize(
    ("facts", "line"),
    [
        (camera(image_size_px=(320, 240)), "images of 320x240 px, intrinsics.json is for 640x480 px"),
        (camera(size=(320, 480), cx=322.0), "point (322, 239.5) lies outside of the image of 320x480 px"),
        (camera(fx=2000.0), "a field of view of 18 degrees, not within 20..140"),
        (camera(fx=100.0), "a field of view of 145 degrees, not within 20..140"),
        (depth(2000.0), "the median depth of drive is 2000 m at 1000 units a metre, not within 0.05..30 m"),
        (depth(10.0, is_unit_stated=False), "10 m at assumed 1000 units a metre, not within 0.2..6 m"),
        ({"times": (times(0.0, 1e6, 2e6),)}, "1e+06 s apart in the median, not within 0.0001..1000 s"),
        ({"times": (times(0.0, 2.0, 1.0, 3.0, 2.5),)}, "2 of 5 time stamps are earlier than the one before"),
        (videos((51, 0.1), (50, 0.1)), "left.avi has 51 images until 5.000 s, right.avi 50 until 4.900 s"),
        (videos((40, 0.1), (60, 0.1)), "left.avi has 40 images until 3.900 s, right.avi 60 until 5.900 s"),
        (videos((51, 0.1), (101, 0.051)), "left.avi has 51 images until 5.000 s, right.avi 101 until 5.100"),
    ],
)  # fmt: skip
def test_facts_that_contradict_each_other_are_refused(facts: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError) as refused:
        check_source(source(**facts))
    assert line in str(refused.value)
    assert refused.value.hint


@pytest.mark.parametrize(
    ("facts", "name", "line"),
    [
        ({"times": (times(0, 1, 2, 1.5, 2.5),)}, "time-order", "goes back by 0.500 s after 2.000000 s"),
        ({"times": (times(0, 1, 1, 2),)}, "equal-stamps", "1 of 4 images have the time stamp of the image"),
        (
            {"times": (times(0, 1, 2),), "references": (times(10, 11),)},
            "reference-times", "covers 10.000..11.000 s, the images 0.000..2.000 s",
        ),
    ],
)  # fmt: skip
def test_unlikely_facts_are_named_until_they_are_accepted(
    facts: dict[str, Any], name: str, line: str
) -> None:
    doubts = check_source(source(**facts))
    assert [each.name.value for each in doubts] == [name]
    assert line in doubts[0].sentence
    assert unresolved(doubts, ()) == doubts
    assert unresolved(doubts, (name,)) == ()


@pytest.mark.parametrize(
    "facts",
    [
        {},
        camera(image_size_px=(640, 480)),
        camera(fx=100.0, model="fisheye"),
        depth(None),
        depth(12.0),
        {"times": (times(0, 1, 2.5),), "references": (times(-5, 1, 9),)},
        videos((50, 0.1), (50, 0.1)),
        videos((51, 0.1), (50, 5.0 / 49)),
        videos((51, 0.1), (26, 0.2)),
    ],
)
def test_healthy_facts_raise_no_doubt(facts: dict[str, Any]) -> None:
    assert check_source(source(**facts)) == ()


@pytest.mark.parametrize(
    ("stamps_s", "rows"),
    [((), []), ((5.0,), [0]), ((0, 1, 1, 2), [0, 1, 3]), ((0, 1, 2, 1.5, 2.5), [0, 1, 2])],
)
def test_rows_are_used_in_the_order_of_time(stamps_s: tuple[float, ...], rows: list[int]) -> None:
    assert rows_in_time(times(*stamps_s))[0] == rows


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (1.7e9, 0.1, "seconds"), (1.7e12, 100, "milliseconds"), (1.7e15, 1e5, "microseconds"),
        (1.7e18, 1e8, "nanoseconds"), (0, 0.033, "seconds"), (0, 5, "seconds"), (50, 33, "milliseconds"),
        (0, 33_333, "microseconds"), (0, 33_333_333, "nanoseconds"),
    ],
)  # fmt: skip
def test_units_of_time_are_distinguished(first: float, step: float, unit: str) -> None:
    assert time_unit_s(np.arange(20, dtype=np.float64) * step + first)[0] == unit


def test_a_name_that_no_finding_has_is_refused() -> None:
    check_accepted(["left-out"])
    with pytest.raises(UsageError, match="--accept left names no finding"):
        check_accepted(["left"])
