"""Maps that can be decoded and hold numbers to spoil what others compute with them: NaN, infinite, enormous.

A map is shared: what one robot wrote into it must not make the requests of others fail.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, RsePfError
from rse_pf.maps.describe import describe_map
from rse_pf.maps.format import Edge, Keyframe, MapVersion, encode_map
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.slam.pose_graph import write_g2o
from rse_pf.wire import Command, Failure, Result
from tests.kit.hostile_maps import hostile_maps
from tests.kit.synthetic_maps import make_sphere, make_world

REGISTRY = builtin_services(PlatformSettings())
INFORMATION = np.diag([100.0, 100, 100, 400, 400, 400])
WORLD = make_world(3)
HONEST = WORLD.walk("a", np.linspace(0, 0.5, 12), 1)[0]
OTHER = WORLD.walk("b", np.linspace(0.1, 0.6, 12), 2)[0]


def asked(service: str, **payload: Any) -> Result | Failure:
    """Ask a service; nothing may be a defect, and no warning of numbers may be written."""
    defects: list[Exception] = []
    with np.errstate(all="ignore"):
        reply = dispatch(
            REGISTRY, Command(id=1, service=service, payload=payload), time.monotonic,
            on_defect=lambda _, error: defects.append(error),
        )  # fmt: skip
    assert not defects
    return reply


def localised(version: MapVersion) -> Any:
    view = HONEST.keyframes[3]
    camera = {name: getattr(view.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    found = asked(
        "localise", map=encode_map(version), camera=camera, pixels=view.pixels.astype(float).ravel(),
        descriptors=view.descriptors.tobytes(),
    )  # fmt: skip
    assert isinstance(found, Result), found
    return found.reply


def with_edges(information: np.ndarray) -> MapVersion:
    steps = zip(HONEST.keyframes, HONEST.keyframes[1:], strict=False)
    return replace(
        HONEST,
        edges=tuple(
            Edge(
                a=one.id, b=other.id, information=information,
                T_a_b=np.linalg.inv(one.T_world_camera) @ other.T_world_camera,
            )
            for one, other in steps
        ),
    )  # fmt: skip


def with_keyframes(change: Callable[[Keyframe], Keyframe]) -> MapVersion:
    return replace(HONEST, keyframes=tuple(map(change, HONEST.keyframes)))


def first_point(value: float) -> Callable[[Keyframe], Keyframe]:
    def change(keyframe: Keyframe) -> Keyframe:
        points = keyframe.points_camera.copy()
        points[0] = value
        return replace(keyframe, points_camera=points)

    return change


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e30, 1e7])
def test_one_point_of_a_keyframe_does_not_spoil_the_map_for_others(value: float) -> None:
    poisoned = with_keyframes(first_point(value))

    assert localised(poisoned).verdict == "ok"
    merged = asked("merge", maps=[encode_map(poisoned), encode_map(OTHER)])
    assert isinstance(merged, Result), merged
    assert merged.reply.joined == [0, 1]


def test_a_keyframe_at_the_end_of_the_world_does_not_spoil_the_map_for_others() -> None:
    copy = HONEST.keyframes[3]
    far = np.eye(4)
    far[0, 3] = 9e8
    poisoned = replace(HONEST, keyframes=(*HONEST.keyframes, replace(copy, id=999, T_world_camera=far)))

    assert localised(poisoned).verdict == "ok"


def test_a_pixel_far_outside_of_every_image_is_refused_at_the_door() -> None:
    pixels = HONEST.keyframes[0].pixels.copy()
    pixels[0] = 1e8

    with pytest.raises(BadRequest, match="a pixel not within"):
        replace(HONEST.keyframes[0], pixels=pixels)


@pytest.mark.parametrize(
    "information",
    [-INFORMATION, np.zeros((6, 6)), np.triu(np.ones((6, 6))), np.diag([1.0, 1, 1, 1, 1, -1e-3])],
)
def test_a_merge_names_the_map_whose_information_is_none(information: np.ndarray) -> None:
    merged = asked("merge", maps=[encode_map(OTHER), encode_map(with_edges(information))])

    assert isinstance(merged, Failure)
    assert merged.code == "bad-request"
    assert "map 1 (the first is 0): the information of edge 0-1" in merged.message
    assert merged.hint == "leave that map out"


@pytest.mark.parametrize("scale", [1e-320, 1e-18, 1e15])
def test_an_information_of_any_other_size_gives_a_map_of_numbers(scale: float) -> None:
    pytest.importorskip("gtsam", reason="pip install 'rse-pf[maps]'")

    merged = asked("merge", maps=[encode_map(with_edges(INFORMATION * scale)), encode_map(OTHER)])

    assert isinstance(merged, Result), merged
    assert np.isfinite([merged.reply.cost_before, merged.reply.cost_after]).all()


@pytest.mark.parametrize(
    "number", ["nan", "inf", "-inf", "1e999", "1e300", "1e19", "-1", "0", "x", "0x1p3", "1_0e400", ""]
)
@pytest.mark.parametrize("at", [10, 30])
def test_a_pose_graph_of_absurd_information_is_a_typed_refusal(number: str, at: int) -> None:
    pytest.importorskip("gtsam", reason="pip install 'rse-pf[maps]'")
    lines = write_g2o(make_sphere(1, rings=2, per_ring=4)[0]).splitlines()
    edge = next(row for row, line in enumerate(lines) if line.startswith("EDGE"))
    words = lines[edge].split()
    words[at] = number
    lines[edge] = " ".join(words)

    found = asked("optimise", g2o="\n".join(lines))

    assert isinstance(found, Failure)
    assert found.code == "bad-request"
    assert found.hint


@pytest.mark.parametrize("name", sorted(hostile_maps()))
def test_what_describes_a_map_refuses_or_survives_it(name: str) -> None:
    with contextlib.suppress(RsePfError):
        describe_map(hostile_maps()[name], 1 << 28)
