"""Send times, payloads and records of the load generator; `tests/system/demo/test_swarm.py` runs it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.config import SessionSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.load.payloads import SolvedPayload, is_right, make_payloads
from rse_pf.extensions.experiments.load.run import report_of, table_of
from rse_pf.extensions.experiments.load.scenario import LoadScenario, read_scenario
from rse_pf.extensions.experiments.load.swarm import SwarmResult, records_of
from rse_pf.extensions.experiments.load.swarm_process import ResultRows
from rse_pf.extensions.experiments.results.records import CommandRecord
from rse_pf.geometry import exp_se3
from rse_pf.pnp import solve_pnp
from rse_pf.services.pnp import PnpReply, PnpRequest
from rse_pf.wire import Command, as_type, make_codec
from rse_pf.wire.preencoded import encode_command


def options(**changes: Any) -> LoadScenario:
    return LoadScenario(**{"robots": 2, **changes})


def payloads(**changes: Any) -> list[SolvedPayload]:
    return make_payloads(options(**changes), SessionSettings())


@pytest.mark.parametrize("codec_name", ["zlib", "json", "bin"])
def test_right_and_wrong_solutions_of_every_payload_are_recognised(codec_name: str) -> None:
    codec = make_codec(codec_name)
    for problem in payloads(codec=codec_name)[:8]:
        data = encode_command(codec, Command(id=1, service="pnp", payload=problem.payload))
        message = codec.decode_from_robot(data)
        assert isinstance(message, Command)
        request = as_type(message.payload, PnpRequest)
        solution = solve_pnp(
            request.points_world.reshape(-1, 3), request.pixels.reshape(-1, 2), request.camera, None
        )
        reply = PnpReply.of(solution)
        assert is_right(problem, {"T_camera_world": reply.T_camera_world.tolist()})
        for twist in ([0.06, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.03, 0]):
            moved = exp_se3(np.array(twist, dtype=np.float64)) @ solution.T_camera_world
            assert not is_right(problem, {"T_camera_world": moved.ravel().tolist()})


def rows() -> ResultRows:
    reported = ResultRows()
    nan = math.nan
    for row, server, code in (
        ((4, 1, 1.0, 1.01, 1.13, 3500, 1.5, 0.25, 2.0, 3.0), "server-1", "ok"),
        ((4, 2, 1.2, 1.20, 6.20, 3500, nan, nan, nan, nan), "", "expired"),
        ((4, 3, 1.4, 1.40, nan, 0, nan, nan, nan, nan), "", ""),
    ):
        reported.numbers.extend(row)
        reported.servers.append(server)
        reported.codes.append(code)
    return reported


def result(commands: list[CommandRecord]) -> SwarmResult:
    return SwarmResult(
        commands=commands, cpu_s=2.0, wall_s=10.0, wrong_poses=0, reconnects=0, resent=0, moves=0,
        duplicates=0, link=None, late_sends_ms_p99=0.5,
        held_back={"busy": 2, "own-limit": 7},
    )  # fmt: skip


def test_the_report_counts_what_was_answered_in_time(tmp_path: Any) -> None:
    report = report_of(LoadScenario(robots=1), result(list(records_of(rows()))), {})
    assert report["commands"]["sent"] == 3
    assert report["commands"]["lost"] == 1
    assert report["failures_by_code"] == {"expired": 1}
    assert report["held_back"] == {"busy": 2, "own-limit": 7}
    assert "2 after busy, 7 by" in table_of(report, tmp_path)
    assert report["answered_in_time_percent"] == pytest.approx(33.333)
    assert report["generator"]["cpu_percent"] == 20.0
    assert report["fps_per_robot"]["mean"] == pytest.approx(1 / 0.6, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is no scenario"), ("[1]", "is no scenario"), ("[" * 9999, "is no scenario"),
        ('{"robots": 1.5}', "robots"), ('{"keep": 1}', "keep"), ('{"robots": 0}', "robots = 0"),
        ('{"url": "ws://x"}', "has no 'url'"), ('{"fps": NaN}', "is no scenario"), ("\xff", "is no scenario"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_scenario_is_refused_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "made").write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError, match=says) as reported:
        read_scenario(tmp_path / "made")
    assert reported.value.hint
    assert "\n" not in reported.value.message
