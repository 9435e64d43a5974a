"""An exported case gives the same answer anywhere, and names nobody."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording.replay.made import Made, jpeg

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest
from rse_pf.pnp.problems import make_degenerate, make_problem
from rse_pf.recording.reader import open_recording
from rse_pf.recording.replay import run
from rse_pf.recording.replay.case import case_parts, write_case
from rse_pf.recording.replay.solving import Resolver
from rse_pf.wire import Result

SETTINGS = PlatformSettings()


def exported(folder: Path, identity: str) -> Path:
    """Return the case of one command."""
    found = run.case_of(folder, SETTINGS, identity)
    path = folder.parent / "case.rsepf"
    write_case(
        path, found.parts, codec=found.codec, number=found.number, metadata=found.metadata, version="1.2.3"
    )
    return path


@pytest.mark.parametrize(
    "codec",
    ["bin", pytest.param("zlib", marks=pytest.mark.slow), pytest.param("json", marks=pytest.mark.slow)],
)
def test_a_case_gives_the_same_bytes_and_the_same_report(tmp_path: Path, codec: str) -> None:
    made = Made(tmp_path / "a")
    for seed in range(3):
        made.send(seed, codec=codec, thumbnail=jpeg(), T_odom_camera=np.eye(4))
    good = made.send(make_problem(seed=8, n=60, outlier_ratio=0.5), codec=codec, deadline_ms=250.0)
    bad = made.send(make_degenerate("mirrored", seed=1), codec=codec, thumbnail=jpeg())
    folder = made.close()

    for identity in (good, bad):
        there = run.report(folder, SETTINGS, identity, with_picture=False)
        here = run.report(exported(folder, identity), SETTINGS, "", with_picture=False)

        assert there.is_equal
        assert here.is_equal
        assert (here.verdict, here.reason, here.rules) == (there.verdict, there.reason, there.rules)
        assert here.round_trip_ms == there.round_trip_ms
    assert here.has_thumbnail


def test_a_case_of_one_command_has_the_size_of_a_few(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    for seed in range(30):
        name = made.send(seed, codec="zlib")

    assert exported(made.close(), name).stat().st_size < 40_000


def test_no_name_that_a_robot_put_anywhere_gets_into_a_case(tmp_path: Path) -> None:
    made = Made(tmp_path / "a", server="warehouse-7")
    secret = "Alice-the-robot"
    camera = {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480, "name": secret}
    payload: dict[str, Any] = {
        "camera": camera,
        "points_world": [1.0] * 30, "pixels": [2.0] * 20, "owner": secret, "options": {"engine": secret},
        "depths_m": secret, "depth_noise": {"name": secret, secret: 1.0},
    }  # fmt: skip
    made.send(1, payload=payload, stream=secret, trace=secret, codec="json")
    answer = Result(id=1, reply={"T_camera_world": secret, "verdict": secret}, server=secret)
    name = made.send(
        2, stream=secret, trace=secret, codec="json", answer=answer, thumbnail=jpeg(comment=secret.encode())
    )
    folder = made.close()
    assert secret.encode() in b"".join(each.read_bytes() for each in folder.glob("*"))

    for identity in ("0", name):
        data = exported(folder, identity).read_bytes()
        assert secret.encode() not in data
        assert b"warehouse" not in data
        assert b"Alice" not in data
        assert str(made.now_ns)[:6].encode() not in data


def test_only_commands_of_pnp_are_exported(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    made.send(1, service="echo", payload={"text": "hello"})
    (command,) = open_recording(made.close()).commands()

    with pytest.raises(BadRequest, match="cannot be exported"):
        case_parts(command, [], Resolver())


def test_a_case_keeps_the_numbers_of_the_server(tmp_path: Path) -> None:
    small = SETTINGS.replace(pnp={"max_iterations": 25})
    made = Made(tmp_path / "a", settings=small)
    name = made.send(make_problem(seed=2, n=80, outlier_ratio=0.7))

    assert run.report(exported(made.close(), name), SETTINGS, "", with_picture=False).is_equal


def test_history_of_another_connection_is_left_out(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    made.send(1)
    made.send(2)
    first, second = open_recording(made.close()).commands()
    other = dataclasses.replace(first, id=f"{'f' * 16}:0")

    assert len(case_parts(second, [first], Resolver())) == 4
    assert len(case_parts(second, [other], Resolver())) == 2
