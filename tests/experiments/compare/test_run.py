"""The whole comparison: table, JSON, picture, trajectories, the spread, and evo's figures."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from client_sdk.trajectory import read_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.compare import run
from rse_pf.extensions.experiments.compare.configurations import configurations_of
from rse_pf.extensions.experiments.compare.report import row_of, runs_line, table_lines
from rse_pf.extensions.experiments.compare.run import CompareOptions, run_compare
from rse_pf.extensions.experiments.compare.solvers import InProcessSolver
from rse_pf.extensions.experiments.compare.tracking_run import track
from tests.kit.compare_recordings import black, flat_drive

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
image = pytest.importorskip("PIL.Image")

SETTINGS = PlatformSettings()


def compare(folder: Path, *words: str, runs: int = 1, **drive: Any) -> dict[str, Any]:
    """Run a comparison on the flat world; return its report."""
    options = CompareOptions(
        configurations=configurations_of(words), drives=[flat_drive(**drive)], runs=runs, out=folder
    )
    assert run_compare(options, SETTINGS) == 0
    report: dict[str, Any] = json.loads((folder / "compare.json").read_text())
    return report


def steady(report: dict[str, Any]) -> list[Any]:
    """Return all figures of a report that no clock gave."""
    return [
        {name: value for name, value in row["figures"].items() if not name.endswith("_ms")}
        | {"poses": row["poses_digest"]}
        for row in report["rows"]
    ]


@pytest.fixture(autouse=True)
def without_evo(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on whether evo is installed."""
    monkeypatch.setattr(run, "evo_command", lambda: None)


def test_two_comparisons_give_the_same_figures(tmp_path: Path) -> None:
    one, two = (
        compare(tmp_path / "a", "default", "features-500"),
        compare(tmp_path / "b", "features-500", "default"),
    )

    assert steady(one) == steady(two)[::-1]


def test_it_writes_a_table_a_picture_and_the_trajectories(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = compare(tmp_path, "default", "without-depth", change=black)

    reported = capsys.readouterr().out
    assert "flat at 10 Hz, colour + depth: 10 frames, 0.9 s; ground truth, SE(3) and Sim(3)" in reported
    assert "7 of 10" in reported
    assert "truth interpolated between true poses at most 0.25 s apart" in reported
    assert report["max_truth_gap_s"] == 0.25
    assert [row["alignment"] for row in report["rows"]] == ["SE(3)", "Sim(3)"]
    assert {"commit", "cores", "load_average", "load_average_after"} <= report["environment"].keys()
    with image.open(tmp_path / "compare.png") as picture:
        assert picture.size == (800, 640)
    path = tmp_path / "trajectories" / "flat-10hz-default-1.txt"
    assert len(read_trajectory(path)) == 7


def test_runs_that_differ_show_the_least_and_the_largest_value() -> None:
    drive = flat_drive()
    (configuration,) = configurations_of(["default"])
    runs = [
        asyncio.run(track(configuration, flat_drive(change=change), InProcessSolver(SETTINGS)))
        for change in (lambda row, frame: frame, black)
    ]

    row = row_of(configuration, drive, runs, [None, None])

    assert row["figures"]["posed"] == (7, 10)
    assert row["same_poses_in_all_runs"] is False
    assert "7 to 10 of 10" in table_lines([row])[1]
    assert "1 of 1 rows differ between runs" in runs_line([row], is_platform=False)


def test_a_recording_without_truth_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = compare(tmp_path, "default", has_truth=False)

    reported = capsys.readouterr().out
    assert "default: the recording has no truth: no ATE, no RPE" in reported
    assert "ATE cm" not in reported
    assert report["rows"][0]["figures"]["posed"] == [10, 10]
    assert (tmp_path / "compare.png").stat().st_size > 0
