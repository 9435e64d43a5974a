"""The experiments run for real, end, and their reports can be computed again from what they wrote."""

from __future__ import annotations

import json

import pytest

from rse_pf.cli.main import main
from rse_pf.extensions.experiments.paper.verify import verify

pytestmark = [pytest.mark.system, pytest.mark.slow]


def run(folder, *words):
    code = main(["experiment", *words, "--out", str(folder)])
    findings = verify(folder)
    return code, json.loads((folder / "report.json").read_text()), [str(f) for f in findings if not f.agrees]


def test_a_kill_under_load_loses_nothing(tmp_path):
    code, report, differing = run(
        tmp_path / "out", "robustness", "--only", "kill", "--robots", "20", "--fps", "5"
    )

    assert (code, differing) == (0, [])
    figures = report["runs"]["kill"]
    assert figures["crashes"] == 1
    assert figures["commands"]["failed"] == 0
    assert figures["gap_s"]["robots"] >= 5
    assert figures["gap_s"]["p99"] <= 2.0
    assert figures["replaced_in_s"] <= 10.0


def test_a_live_map_loses_nothing_when_its_server_is_killed_or_its_store_fails(tmp_path):
    code, report, differing = run(
        tmp_path / "out", "live", "--only", "kill,store", "--robots", "2", "--frames", "60", "--fps", "3"
    )

    assert (code, differing) == (0, [])
    for run_figures in report["runs"].values():
        kept = run_figures["keyframes"]
        assert kept["acknowledged"] == kept["in_log"] == kept["made"] >= 16
        assert (kept["lost"], kept["twice"], kept["out_of_order"]) == (0, 0, 0)
        assert run_figures["frames_lost"] == 0
        assert run_figures["replay_equal"] == 1
    assert report["runs"]["kill"]["owners"] == 2


def test_two_robots_map_and_their_errors_are_those_of_their_files(tmp_path):
    code, report, differing = run(tmp_path / "out", "map", "--robots", "2", "--frames", "12")

    assert (code, differing) == (0, [])
    assert report["lost_frames"] == [0, 0]
    assert all(0.0 < error < 5.0 for error in report["ate_cm"])

    path = tmp_path / "out" / "robot-1" / "trajectory.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-2]) + "\n")
    assert "lost_frames" in {finding.what for finding in verify(tmp_path / "out") if not finding.agrees}
