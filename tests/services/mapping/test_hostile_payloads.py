"""Hostile payloads of the mapping services get a reply or a typed failure in bounded time (threat T26)."""

from __future__ import annotations

import inspect
import math
import sys
import time
from typing import Any

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import LimitExceeded
from rse_pf.maps.format import decode_map, encode_map
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.mapping import place as place_service
from rse_pf.slam import consistency
from rse_pf.slam.consistency import find_maximum_clique
from rse_pf.slam.map_merge import merge_versions
from rse_pf.wire import Command, Failure, Result, make_codec
from tests.kit.hostile_maps import DECODABLE, hostile_maps
from tests.kit.synthetic_maps import make_room, make_world

REGISTRY = builtin_services(PlatformSettings())
EYE = np.eye(4).ravel().tolist()
CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
WORLD, _ = make_world(3).walk("robot-1", np.linspace(0.0, 0.2, 4), seed=5)
MAP = encode_map(WORLD)
ROOM = make_room(1, points=400).ravel().tolist()
VERTICES = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
UPPER = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {UPPER}\n"


def asked(service: str, payload: Any) -> Result | Failure:
    """Answer a command that came by the codec, whose payload may hold NaN."""
    codec = make_codec("bin")
    sent = Command(id=1, service=service, payload=payload)
    command = codec.decode_from_robot(codec.encode(sent)) if service != "merge" else sent
    assert isinstance(command, Command)
    return dispatch(REGISTRY, command, time.monotonic)


def view(rows: int = 40, **other: Any) -> dict[str, Any]:
    rng = np.random.default_rng(rows)
    return {
        "map": MAP, "camera": CAMERA, "pixels": rng.uniform(0, 480, 2 * rows).astype(np.float32),
        "descriptors": rng.bytes(32 * rows), **other,
    }  # fmt: skip


def cloud(**other: Any) -> dict[str, Any]:
    return {"target": ROOM, "source": ROOM, "T_target_source": EYE, **other}


def survey(places: list[tuple[float, float, float]], **options: Any) -> dict[str, Any]:
    heard = {"a1": -50.0, "a2": -60.0, "a3": -70.0}
    return {
        "scan": {"rssi_dbm": heard}, "options": options,
        "survey": [{"rssi_dbm": heard, "position": place} for place in places],
    }  # fmt: skip


LINE = [(float(n), 0.0, 1.0) for n in range(40)]
HOSTILE: dict[str, tuple[str, dict[str, Any]]] = {
    "icp, a point that is not a number": ("icp", cloud(source=[math.nan, *ROOM[1:]])),
    "icp, a point at the end of the range": ("icp", cloud(source=[1e300, *ROOM[1:]])),
    "icp, a cloud far away": ("icp", cloud(source=[1e7 + each for each in ROOM])),
    "icp, a guess far away": ("icp", cloud(T_target_source=[*EYE[:3], 1e200, *EYE[4:]])),
    "icp, equal points": ("icp", cloud(source=[1.0] * 3000)),
    "icp, a plane": ("icp", cloud(source=[1.0, 2.0, 0.0] * 200 + ROOM[:1200])),
    "icp, a voxel of a nanometre": ("icp", cloud(options={"voxel_m": 1e-9})),
    "icp, a voxel that is not a number": ("icp", cloud(options={"voxel_m": math.nan})),
    "icp, endless iterations": ("icp", cloud(options={"max_iterations": 10**9})),
    "icp, a negative count": ("icp", cloud(options={"max_iterations": -1})),
    "icp, two numbers": ("icp", cloud(source=[1.0, 2.0])),
    "icp, nothing": ("icp", cloud(source=[])),
    "wifi, no position": ("wifi", survey([(math.nan, 0.0, 0.0)] * 40)),
    "wifi, a position at the end of the world": ("wifi", survey([*LINE, (1e9, 0.0, 0.0)])),
    "wifi, a corridor around the earth": ("wifi", survey([*LINE, (9e4, 0.0, 1.0)], reach_m=1e-6)),
    "wifi, all at one place": ("wifi", survey([(1.0, 1.0, 1.0)] * 40, reach_m=1e-9, grid_m=5.0)),
    "wifi, a grid of nanometres": ("wifi", survey(LINE, grid_m=1e-9)),
    "wifi, a strength that is not a number": (
        "wifi", survey(LINE) | {"scan": {"rssi_dbm": {"a1": math.nan}}},
    ),
    "wifi, a thousand floors": ("wifi", survey([(1.0, 1.0, float(n)) for n in range(1000)])),
    "wifi, a hall of many floors": (
        "wifi", survey([(97.0 * n % 300, 31.0 * n % 300, n % 90) for n in range(900)], reach_m=50.0),
    ),
    "wifi, a thousand access points": (
        "wifi",
        {
            "scan": {"rssi_dbm": {"a1": -50.0}},
            "survey": [
                {"rssi_dbm": {f"a{n}": -50.0 for n in range(1000)}, "position": (float(k), 0.0, 0.0)}
                for k in range(6)
            ],
        },
    ),
    "wifi, no survey": ("wifi", survey([])),
    "optimise, an id of 400 digits": ("optimise", {"g2o": VERTICES.replace("QUAT 1", "QUAT " + "9" * 400)}),
    "optimise, an id beyond 63 bits": ("optimise", {"g2o": VERTICES.replace("QUAT 1", f"QUAT {2**63}")}),
    "optimise, a negative id of 63 bits": ("optimise", {"g2o": VERTICES.replace("QUAT 1", f"QUAT {-2**63}")}),
    "optimise, a pose at the end of the range": ("optimise", {"g2o": VERTICES.replace("1 1 0", "1 1e308 0")}),
    "optimise, a pose that is not a number": ("optimise", {"g2o": VERTICES.replace("1 1 0", "1 nan 0")}),
    "optimise, a measurement at the end of the range": (
        "optimise", {"g2o": VERTICES + EDGE.replace("0 1 1 0", "0 1 1e308 0")},
    ),
    "optimise, information at the end of the range": (
        "optimise", {"g2o": VERTICES + EDGE.replace(UPPER, UPPER.replace("1", "1e300"))},
    ),
    "optimise, information of a gap": (
        "optimise", {"g2o": VERTICES + EDGE.replace(UPPER, "1e18" + UPPER[1:-1] + "1e-300")},
    ),
    "optimise, negative information": ("optimise", {"g2o": VERTICES + EDGE.replace(UPPER, "-" + UPPER)}),
    "optimise, no vertices": ("optimise", {"g2o": ""}),
    "optimise, an edge to itself": ("optimise", {"g2o": VERTICES + EDGE.replace("0 1 1", "0 0 1", 1)}),
    "optimise, a kernel that is not a number": (
        "optimise", {"g2o": VERTICES + EDGE, "options": {"cauchy": math.nan}},
    ),
    "place, a negative number of candidates": ("place", view(candidates=-5)),
    "place, half a descriptor": ("place", view(descriptors=b"half")),
    "place, a prior that is not a number": (
        "place", view(within={"x": math.nan, "y": 0.0, "z": 0.0, "radius_m": math.inf}),
    ),
    "localise, a tolerance that is not a number": ("localise", view(options={"agree_m": math.nan})),
    "localise, a ratio that is not a number": ("localise", view(options={"min_inlier_ratio": math.nan})),
    "merge, no maps": ("merge", {"maps": []}),
    "merge, a kernel without end": ("merge", {"maps": [MAP], "options": {"cauchy": math.inf}}),
}  # fmt: skip
ANSWERED = {
    "icp, equal points", "icp, a plane", "wifi, a corridor around the earth", "wifi, all at one place",
    "optimise, information of a gap", "place, a prior that is not a number",
}  # fmt: skip
"""Unusual requests that may have a reply."""


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_payload_is_a_typed_failure(name: str) -> None:
    service, payload = HOSTILE[name]

    begin = time.thread_time()
    answer = asked(service, payload)

    assert time.thread_time() - begin < 10.0
    if isinstance(answer, Failure):
        assert answer.code in ("bad-request", "bad-message", "too-large", "missing-extra"), answer
        assert answer.hint
    else:
        assert name in ANSWERED, answer


@pytest.mark.parametrize("service", ["place", "merge"])
def test_every_hostile_map_is_a_typed_failure(service: str) -> None:
    for name, data in hostile_maps().items():
        if name in DECODABLE:
            continue
        payload = {"maps": [data, MAP]} if service == "merge" else view(map=data)
        answer = dispatch(REGISTRY, Command(id=1, service=service, payload=payload), time.monotonic)

        assert isinstance(answer, Failure), name
        assert answer.code in ("bad-request", "too-large", "invalid-camera"), (name, answer)


def test_too_large_a_view_is_refused() -> None:
    large = view(pixels=np.zeros(40_002, dtype=np.float32), descriptors=bytes(32 * 20_001))

    answer = dispatch(REGISTRY, Command(id=1, service="place", payload=large), time.monotonic)

    assert isinstance(answer, Failure)
    assert answer.code == LimitExceeded.code


def test_too_many_comparisons_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    most = max(len(each.descriptors) for each in WORLD.keyframes) * 40 * 4
    monkeypatch.setattr(place_service, "_MAX_COMPARISONS", most - 1)

    for service in ("place", "localise"):
        answer = asked(service, view())
        assert isinstance(answer, Failure)
        assert answer.code == LimitExceeded.code
    monkeypatch.setattr(place_service, "_MAX_COMPARISONS", most)
    assert isinstance(asked("place", view()), Result)


@pytest.mark.parametrize("seed", range(12))
def test_the_maximum_clique_does_not_depend_on_how_vertices_are_coloured(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((40, 40)) < rng.uniform(0.1, 0.9), 1)
    agree = upper | upper.T

    one_by_one = find_maximum_clique(agree)
    monkeypatch.setattr(consistency, "MANY_VERTICES", 1)

    np.testing.assert_array_equal(find_maximum_clique(agree), one_by_one)


def test_a_clique_may_be_larger_than_the_recursion_limit() -> None:
    agree = ~np.eye(250, dtype=np.bool_)
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack(0)) + 100)
    try:
        found = find_maximum_clique(agree)
    finally:
        sys.setrecursionlimit(limit)

    np.testing.assert_array_equal(found, np.arange(250))


def test_a_map_that_was_merged_often_stays_readable() -> None:
    bulky = {"parents": [{"from": [[0, n] for n in range(29_000)]}], "robot": "robot-1"}
    versions = [decode_map(encode_map(type(WORLD)(keyframes=WORLD.keyframes, provenance=bulky)))] * 2

    merged = merge_versions(versions).version

    after = decode_map(encode_map(merged)).provenance
    assert after["parents"] == [{"robot": "robot-1"}] * 2
    assert len(after["from"]) == len(merged.keyframes)


def test_merging_refuses_more_maps_than_can_be_paired() -> None:
    answer = asked("merge", {"maps": [MAP] * 65, "options": {"candidates": 100}})

    assert isinstance(answer, Failure)
    assert "65 maps are not within 1..64" in answer.message


@pytest.mark.parametrize("payload", [cloud(source=[1e7 + each for each in ROOM]), cloud(target=[1e12] * 300)])
def test_clouds_beyond_the_voxels_of_the_solver_are_refused_before_it_is_asked(payload: Any) -> None:
    answer = asked("icp", payload)

    assert isinstance(answer, Failure)
    assert "500000 voxels" in answer.message


def test_merging_refuses_more_pairs_than_can_be_tried() -> None:
    answer = asked("merge", {"maps": [MAP] * 64, "options": {"candidates": 100}})

    assert isinstance(answer, Failure)
    assert answer.code == LimitExceeded.code
