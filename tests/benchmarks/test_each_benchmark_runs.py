"""Each benchmark runs for some seconds and reports its figures, so that none breaks unseen.

Such a run measures nothing: with ``--short`` only the bars are checked that neither time nor load can miss.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

REPOSITORY = Path(__file__).parents[2]
DEADLINE_S = 280.0
CANNOT_MEASURE = 2  # the exit code where a program or a folder is missing

RUNS = {
    "check.table": (["--seeds", "1", "--frames", "16", "--only", "dark"], "by_fault.dark.n"),
    "data.kills": (["--kills", "6"], "acknowledged"),
    "hostile.one_tenant": (["--pairs", "1", "--seconds", "3", "--only", "leave"], "leave.p99_ms.pose.0"),
    "hostile.tenants": (["--commands", "300"], "commands.acme"),
    "live.floor_plan": (["--robots", "1", "--length-m", "6"], "rounds.0.right_percent.all"),
    "live.one_process": (["growth", "--keyframes", "300"], "wide.keyframes"),
    "maps.wheels": (
        ["--only", "drives", "covers", "--drives", "1", "--covers", "1", "--length-m", "6"],
        "drives.rows.office 0.frames",
    ),
    "server.capacity": (
        ["--workers", "1", "--connected", "100", "--seconds", "0.5", "--search-s", "1"],
        "connected.kib_per_robot",
    ),
    "server.idle_memory": (["--robots", "100", "--workers", "1"], "kib_per_robot"),
    "server.overload": (["--most", "20", "--seconds", "1", "--multiples", "1", "2"], "answered_percent.at_2"),
    "server.sdk_overload": (["--sdk", "python"], "offered.python"),
}
"""Its arguments, and one figure that it reports, by the name of each benchmark."""

RUNS_ON_RECORDINGS = {
    "cloud.batch": (["--copies", "2", "--frames", "12", "--candidates", "1"], "links"),
    "live.one_process": (["kitchen", "--runs", "0"], "one_robot.final_cm"),
    "maps.calibration": (["DATA", "--only", "kitchen"], "kitchen.seconds"),
    "maps.photos": (["DATA", "--n", "2"], "cpu_p50_ms"),
    "maps.starts": (["DATA", "--only", "rest", "--seconds", "0.5"], "rest.n"),
    "maps.tracking": (["--only", "3 Hz from frame 0, m"], "rows.fr1/rpy, 3 Hz from frame 0, mirrored.frames"),
    "peers.orbslam3": (
        ["python", "words.txt", "--part", "ours", "--only", "9.6 Hz STEREO", "--folder", "FOLDER"],
        "rows.0.ours.posed",
    ),
    "peers.vocabulary": (["DATA/kitti_06_start", "--every", "20", "--words", "FOLDER/words.txt"], "words"),
}


def run(name: str, arguments: list[str], folder: Path) -> dict[str, Any]:
    """Run a benchmark, and return its report; skips the test where a program is missing."""
    out = folder / "report.json"
    command = [sys.executable, "-m", "benchmarks", name, *arguments, "--short", "--out", str(out)]
    ended = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    if ended.returncode == CANNOT_MEASURE:
        pytest.skip(ended.stderr.strip().splitlines()[-2])
    assert ended.returncode == 0, ended.stderr[-2000:]
    report: dict[str, Any] = json.loads(out.read_text())
    return report


def figure_of(figures: Any, path: str) -> Any:
    for key in path.split("."):
        figures = figures[int(key)] if isinstance(figures, list) else figures[key]
    return figures


@pytest.mark.parametrize("name", RUNS)
def test_it_reports_its_figures(name: str, tmp_path: Path) -> None:
    arguments, figure = RUNS[name]

    assert figure_of(run(name, arguments, tmp_path)["figures"], figure) > 0


SLOW = {"maps.calibration"}
"""A calibration without a board takes minutes on a machine that does other work, too."""


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in RUNS_ON_RECORDINGS],
)
def test_it_reports_its_figures_of_recordings(name: str, recordings: Path, tmp_path: Path) -> None:
    arguments, figure = RUNS_ON_RECORDINGS[name]
    filled = [each.replace("DATA", str(recordings)).replace("FOLDER", str(tmp_path)) for each in arguments]

    assert figure_of(run(name, filled, tmp_path)["figures"], figure) > 0


def test_many_robots_drive_in_one_live_map(tmp_path: Path) -> None:
    features = str(tmp_path / "features")
    drives = ["--robots", "2", "--rooms", "2", "--frames", "12"]
    run("live.many", ["prepare", "--features", features, *drives], tmp_path)

    report = run("live.many", ["run", "--features", features, "--folder", str(tmp_path / "out")], tmp_path)

    assert figure_of(report, "figures.rounds.0.keyframes") > 0
    assert figure_of(report, "figures.rounds.0.lost_frames") == 0


def test_no_pose_is_in_a_room_that_looks_the_same(tmp_path: Path) -> None:
    """With one lens this drive closes a false loop, unless a loop closure may not correct 10 m."""
    report = run("maps.twins", ["--drives", "1", "--first", "50", "--only", "rooms"], tmp_path)

    assert figure_of(report, "figures.rooms.depth.jumps") == 0
    assert figure_of(report, "figures.rooms.one_lens.jumps") == 0


def test_the_server_of_the_paper_is_compared_with_ours(tmp_path: Path) -> None:
    """Skipped where nginx, its Lua or the sources of the paper's server are missing."""
    sources = REPOSITORY.parent / "shared" / "tools" / "peer"

    report = run("server.peer", [str(sources), "--rounds", "1", "--seconds", "0.5"], tmp_path)

    assert figure_of(report, "figures.compared.bin 30 % 1.cpu_ratio") > 0


def test_each_benchmark_is_tried_here() -> None:
    command = [sys.executable, "-m", "benchmarks"]
    listed = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=DEADLINE_S, check=True
    )

    names = {line.split()[0] for line in listed.stdout.splitlines()}
    assert names == {
        *RUNS, *RUNS_ON_RECORDINGS, "live.goals", "live.many", "maps.twins", "server.peer",
    }  # fmt: skip
