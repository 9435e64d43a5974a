"""Compare ORB-SLAM3 with our tracker on the same frames and by the same errors, in several runs.

    python -m venv PEER && PEER/bin/pip install pyorbslam3==0.1.1 opencv-python-headless
    python -m benchmarks peers.vocabulary ../shared/data --words words.txt
    python -m benchmarks peers.orbslam3 PEER/bin/python words.txt --folder comparison

The peer runs in its own environment and process (`orbslam3_process.py`), gets images and gives trajectory
files; no code of the peer is imported here.  The peer gets the next frame when its threads are idle, or by
the time stamps at --speed times real time; our tracker runs as in `rse-pf compare`.  Writes
``comparison.json``, ``runs.csv`` and ``report.md``, figures only; rows that are not measured in this run keep
their figures.

There are no bars: the figures of both systems are reported, with every run and its lost frames.
"""

from __future__ import annotations

import asyncio
import csv
import io
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks.frame.registry import Recordings, benchmark
from benchmarks.frame.report import say
from client_sdk.datasets import CameraChoice, Dataset, associate_stamps
from client_sdk.frontend import load_opencv
from client_sdk.rigs.benchmark_files import read_euroc_camera
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig_file import read_intrinsics
from client_sdk.trajectory import Trajectory, read_trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.compare.configurations import Configuration, configurations_of
from rse_pf.extensions.experiments.compare.recordings import drives_of
from rse_pf.extensions.experiments.compare.solvers import InProcessSolver
from rse_pf.extensions.experiments.compare.tracking_run import longest_gap_s, track
from rse_pf.extensions.experiments.results.markdown import page, table
from rse_pf.extensions.experiments.results.result_folder import environment, load_average, write_json
from rse_pf.geometry import Array, inverse

__all__ = []

# Paragraph of the report on figures that are not comparable.
_NOT_COMPARABLE = """\
- Time: neither side ran in real time. The CPU of the peer is that of all its threads (tracking, mapping, loop
  closing); ours is that of the robot, on one thread, and of the server's solver with its codec. Between two
  frames the peer had the time that its threads wanted, which a robot does not give.
- Corrections: the peer adjusts its map in the background and closes loops, so that the poses as returned and
  at the end differ; as returned they may also be of several maps, each in a frame of its own. Ours adjusts
  nothing with depth, and all keyframes once at the end without depth, and of stereo pairs (which was built
  later: KITTI 06 is of commit bd6ad034); as returned, its first segment counts.
- Place: the peer needs its map, its vocabulary and all threads on the robot; ours sends 4 to 7 kB a frame.
- The vocabulary was trained on images of these very recordings, which favours the peer; it has far fewer
  words than the one that ORB-SLAM3 comes with, which does not.
- Settings are those of the peer's examples for each recording; nothing was tuned on either side.
- Runs of the peer differ; ours are the same to the last bit.
- Posed are, of the peer, the frames of its largest map at the end; of ours, the first segment and what was
  joined to it. An ATE of fewer frames is of a shorter path.
- A camera that stands still would have an ATE of 5.0 cm on fr1/rpy: see the rotations.
- Only the first part of each recording was played, as JPEG: no figure replaces one of the papers."""

Sensor = Literal["RGBD", "STEREO", "MONOCULAR"]
# Examples of feature plugins that are compared.
_EXAMPLES = ("sift:sift", "xfeat:xfeat")
# Folder of the examples of feature plugins.
_EXAMPLES_FOLDER = Path(__file__).resolve().parents[2] / "examples" / "features"
# Program that runs ORB-SLAM3 in the peer's environment.
_PROCESS = Path(__file__).with_name("orbslam3_process.py")
_KITCHEN = "7scenes_redkitchen"  # recording with depth
_TURNING = "tum_fr1_rpy_start"  # recording with depth of a camera that turns quickly
_EUROC = "euroc_mh01_start"  # stereo recording
_KITTI_STEREO = "kitti_06_start"  # stereo recording
_KITTI = "kitti_00_left_start"  # recording of one camera
_LONGEST_S = 600.0  # time limit of one run of the peer
_MIN_POSES_SHARE = 0.95  # smallest share of our number of poses at which the peer has about as many
_MAX_STAMP_DIFFERENCE_S = 0.02  # largest difference of the time stamps of a pose and of its true pose
_DEPTH_BASELINE_M = 0.08  # baseline of a Kinect in ORB-SLAM3's examples
_TOO_FAR = 40.0  # distance, in baselines, from which ORB-SLAM3's examples count a point as far
# Number of ORB features of an image by sensor, as in ORB-SLAM3's examples.
_FEATURES: dict[Sensor, int] = {"RGBD": 1000, "STEREO": 1200, "MONOCULAR": 1000}
_FEATURES_OF_KITTI = 2000  # number of ORB features of an image of KITTI, as in ORB-SLAM3's examples


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments: *runs* is the number of runs of each row of the comparison."""

    python: Annotated[Path, "of the environment of the peer"]
    vocabulary: Path
    recordings: Recordings = Path("../shared/data")
    folder: Annotated[Path, "folder of the report"] = Path("comparison")
    runs: int = 3
    speed: Annotated[float, "times real time; 0 gives a frame when all threads rest (default)"] = 0.0
    only: Annotated[str, "rows whose name and sensor contain this"] = ""
    part: Annotated[Literal["both", "ours", "peer"], "who is measured now"] = "both"
    more: Annotated[bool, "add runs of the peer to those that are there"] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A recording at several rates with a sensor, and the name of our configuration that is compared.

    ``ours`` is empty if no configuration of ours is compared.  ``features`` names examples of feature plugins
    that are compared as well.
    """

    recording: str
    rates_hz: tuple[float, ...]
    sensor: Sensor
    ours: str
    features: tuple[str, ...] = ()


# The compared recordings, rates and sensors.
ROWS = (
    Row(recording=_TURNING, rates_hz=(30, 15, 10, 5), sensor="RGBD", ours="default", features=_EXAMPLES),
    Row(recording=_KITCHEN, rates_hz=(10, 5), sensor="RGBD", ours="default", features=_EXAMPLES),
    Row(recording=_KITCHEN, rates_hz=(10, 5), sensor="MONOCULAR", ours="without-depth"),
    Row(recording=_EUROC, rates_hz=(20, 10, 5), sensor="STEREO", ours="default"),
    Row(recording=_EUROC, rates_hz=(20, 10), sensor="MONOCULAR", ours="without-depth"),
    Row(recording=_KITTI_STEREO, rates_hz=(9.6,), sensor="STEREO", ours="default"),
    Row(recording=_KITTI_STEREO, rates_hz=(9.6,), sensor="MONOCULAR", ours="without-depth"),
    Row(recording=_KITTI, rates_hz=(9.6,), sensor="MONOCULAR", ours="without-depth"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Job:
    """The input of the peer: its settings, the images, and the pose of its camera in ours and in the body."""

    settings: str
    frames: list[tuple[float, str, str | None]]
    T_camera_peer: Array


def job_of(recordings: Path, drive: Dataset, sensor: Sensor) -> Job:
    """Return the peer's job for a drive."""
    name, stamps_s = drive.name, drive.timestamps_s
    folder, rows = recordings / name, drive.rows
    same = np.eye(4)
    if name in (_KITCHEN, _TURNING):
        colours, depths = _listed(folder / "rgb.txt"), _listed(folder / "depth.txt")
        pairs = associate_stamps(
            [stamp for stamp, _ in colours], [stamp for stamp, _ in depths], _MAX_STAMP_DIFFERENCE_S
        )
        lens = read_intrinsics(folder / "intrinsics.json")
        frames = [
            (stamp, str(folder / colours[pairs[row][0]][1]), str(folder / depths[pairs[row][1]][1]))
            for stamp, row in zip(stamps_s, rows, strict=True)
        ]
        more = [f"RGBD.DepthMapFactor: {lens.depth_units_per_m:.1f}", *_baseline(_DEPTH_BASELINE_M)]
        return Job(settings=_yaml(lens, sensor, drive.rate_hz, more), frames=frames, T_camera_peer=same)
    if name == _EUROC:
        images = folder / "mav0"
        left = read_euroc_camera(images / "cam0" / "sensor.yaml", "left")
        lens = left.lens
        lines = (images / "cam0/data.csv").read_text().splitlines()[1:]
        names = [line.split(",")[1].strip() for line in lines]
        frames = [
            (stamp, str(images / "cam0/data" / names[row]), str(images / "cam1/data" / names[row]))
            for stamp, row in zip(stamps_s, rows, strict=True)
        ]
        if sensor == "MONOCULAR":
            return Job(settings=_yaml(lens, sensor, drive.rate_hz, []), frames=frames, T_camera_peer=same)
        right = read_euroc_camera(images / "cam1" / "sensor.yaml", "right")
        T_left_right = inverse(left.T_body_camera) @ right.T_body_camera
        return Job(
            settings=_yaml(lens, sensor, drive.rate_hz, _two_lenses(right.lens, T_left_right)),
            frames=frames, T_camera_peer=_rectified(lens, right.lens, T_left_right),
        )  # fmt: skip
    names = sorted(path.name for path in (folder / "image_0").iterdir())
    frames = [
        (stamp, str(folder / "image_0" / names[row]), str(folder / "image_1" / names[row]))
        for stamp, row in zip(stamps_s, rows, strict=True)
    ]
    lens = Intrinsics(camera=drive.camera)
    settings = _yaml(lens, sensor, drive.rate_hz, [])
    if sensor == "STEREO":
        numbers = [float(word) for word in (folder / "calib.txt").read_text().splitlines()[1].split()[1:]]
        settings = _rectified_yaml(lens, drive.rate_hz, -numbers[3])
    return Job(settings=settings, frames=frames, T_camera_peer=same)


def run_peer(args: Options, drive: Dataset, sensor: Sensor, job: Job) -> dict[str, Any]:
    """Run the peer once in a process of its own; return its figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "settings.yaml").write_text(job.settings)
        frames = [(s, one, None if sensor == "MONOCULAR" else two) for s, one, two in job.frames]
        plan = {
            "vocabulary": str(args.vocabulary.resolve()), "settings": str(folder / "settings.yaml"),
            "sensor": sensor, "speed": args.speed, "frames": frames, "out": name,
        }  # fmt: skip
        (folder / "job.json").write_text(json.dumps(plan))
        with (folder / "log.txt").open("w") as log:
            done = subprocess.run(
                [str(args.python), str(_PROCESS), str(folder / "job.json")],
                stdout=log, stderr=subprocess.STDOUT, timeout=_LONGEST_S, check=False,
            )  # fmt: skip
        if not (folder / "figures.json").exists():
            tail = (folder / "log.txt").read_text(errors="replace").splitlines()[-3:]
            return {"failed": f"exit code {done.returncode}: {' / '.join(tail)[:200]}"}
        figures: dict[str, Any] = json.loads((folder / "figures.json").read_text())
        figures["load_average"] = load_average()[0]
        for which in ("final", "online"):
            figures[which] = _scored(
                read_trajectory(folder / f"{which}.txt"), drive, sensor, job.T_camera_peer
            )
    return figures


def run_ours(configuration: Configuration, drive: Dataset) -> dict[str, Any]:
    """Run our tracker once, as `rse-pf compare` does; return its figures."""
    run = asyncio.run(track(configuration, drive, InProcessSolver(PlatformSettings())))
    return {
        **run.figures,
        **{f"{name}_ms": value for name, value in run.times_ms.items()},
        "digest": run.digest,
    }


def _scored(estimate: Trajectory, drive: Dataset, sensor: Sensor, T_camera_peer: Array) -> dict[str, Any]:
    """Return poses, gap and errors of a trajectory of the peer's camera."""
    assert drive.truth is not None
    scored: dict[str, Any] = {
        "posed": len(estimate),
        "longest_gap_s": longest_gap_s(np.array(drive.timestamps_s), estimate.timestamps_s),
        "ate_cm": None, "rpe_cm": None, "rpe_deg": None,
    }  # fmt: skip
    body = None if drive.T_body_camera is None else drive.T_body_camera @ T_camera_peer
    truth = Trajectory(drive.truth.timestamps_s, drive.truth.T_world_camera @ T_camera_peer)
    try:
        errors = accuracy(estimate, truth, with_scale=sensor == "MONOCULAR", T_body_camera=body)
    except UsageError:
        return scored
    rpe_cm = None if errors.rpe_m is None else 100 * errors.rpe_m
    return {**scored, "ate_cm": 100 * errors.ate_m, "rpe_cm": rpe_cm, "rpe_deg": errors.rpe_deg}


def _listed(path: Path) -> list[tuple[float, str]]:
    rows = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return sorted((float(stamp), name) for stamp, name in rows)


def _yaml(lens: Intrinsics, sensor: Sensor, rate_hz: float, more: Sequence[str]) -> str:
    """Return a settings file of ORB-SLAM3 (version 1.0)."""
    camera = lens.camera
    lines = [
        "%YAML:1.0", 'File.version: "1.0"', 'Camera.type: "PinHole"', *_lens("Camera1", lens),
        f"Camera.width: {camera.width}", f"Camera.height: {camera.height}",
        f"Camera.fps: {max(1, round(rate_hz))}", "Camera.RGB: 1", f"Stereo.ThDepth: {_TOO_FAR}",
        *more, *_shared_lines(_FEATURES_OF_KITTI if camera.width > 1000 else _FEATURES[sensor]),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _rectified_yaml(lens: Intrinsics, rate_hz: float, baseline_fx: float) -> str:
    """Return the older form of the settings of a rectified pair; the newer form crashes version 0.1.1."""
    camera = lens.camera
    lines = [
        "%YAML:1.0", 'Camera.type: "PinHole"', *_lens("Camera", lens),
        *(f"Camera.{name}: 0.0" for name in ("k1", "k2", "p1", "p2")),
        f"Camera.width: {camera.width}", f"Camera.height: {camera.height}",
        f"Camera.fps: {float(rate_hz)}", "Camera.RGB: 1", f"Camera.bf: {baseline_fx!r}",
        f"ThDepth: {_TOO_FAR}", *_shared_lines(_FEATURES_OF_KITTI),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _shared_lines(features: int) -> list[str]:
    viewer = {
        "KeyFrameSize": 0.05, "KeyFrameLineWidth": 1.0, "GraphLineWidth": 0.9, "PointSize": 2.0,
        "CameraSize": 0.08, "CameraLineWidth": 3.0, "ViewpointX": 0.0, "ViewpointY": -0.7, "ViewpointZ": -1.8,
        "ViewpointF": 500.0,
    }  # fmt: skip
    return [
        f"ORBextractor.nFeatures: {features}", "ORBextractor.scaleFactor: 1.2", "ORBextractor.nLevels: 8",
        "ORBextractor.iniThFAST: 20", "ORBextractor.minThFAST: 7",
        *(f"Viewer.{name}: {value}" for name, value in viewer.items()),
    ]  # fmt: skip


def _lens(name: str, lens: Intrinsics) -> list[str]:
    camera = lens.camera
    values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    values |= dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=False))
    return [f"{name}.{each}: {float(value)!r}" for each, value in values.items()]


def _baseline(metres: float) -> list[str]:
    return [f"Stereo.b: {metres:.6f}"]


def _two_lenses(right: Intrinsics, T_left_right: Array) -> list[str]:
    numbers = ", ".join(f"{value:.12g}" if value % 1 else f"{value:.1f}" for value in T_left_right.ravel())
    return [
        *_lens("Camera2", right),
        "Stereo.T_c1_c2: !!opencv-matrix", "  rows: 4", "  cols: 4", "  dt: f", f"  data: [{numbers}]",
    ]  # fmt: skip


def _rectified(left: Intrinsics, right: Intrinsics, T_left_right: Array) -> Array:
    """Return the pose of the rectified left camera in the left one, as ORB-SLAM3 rectifies."""
    T_right_left = inverse(T_left_right)
    size = (left.camera.width, left.camera.height)
    rotation = load_opencv().stereoRectify(
        left.camera.matrix, np.array(left.distortion), right.camera.matrix, np.array(right.distortion), size,
        T_right_left[:3, :3], T_right_left[:3, 3], alpha=-1,
    )[0]  # fmt: skip
    T_left_rectified = np.eye(4)
    T_left_rectified[:3, :3] = rotation.T
    return T_left_rectified


def report_page(report: dict[str, Any]) -> str:
    """Return ``report.md``: our run and the best run of the peer for each row; ``runs.csv`` has all runs."""
    about = report["environment"]
    head = (
        "recording", "frames", "sensor", "posed: ours, peer", "ATE cm: ours, peer",
        "RPE cm / deg over 1 s: ours, peer", "ours is behind",
    )  # fmt: skip
    return page(
        "# Our tracker compared with ORB-SLAM3",
        f"Commit {about['commit']}. {report.get('peer', 'No peer')}; {_pace(report.get('speed', 0.0))}; "
        f"ours once: it is deterministic. {about['cores']} cores, {about['system']}, Python "
        f"{about['python']}; load average {about['load_average']} before our runs, "
        f"{report['load_average_after']} after them. Of the peer, the best run is shown; "
        "[runs.csv](runs.csv) has all runs, gaps, poses as returned, and CPU times.",
        table(head, [_summary_of(row) for row in report["rows"]]),
        "## What is not comparable",
        _NOT_COMPARABLE,
    )


def runs_table(report: dict[str, Any]) -> str:
    """Return ``runs.csv``: a line for each run."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ("recording", "frames", "sensor", "who", "run", "posed", "longest gap s", "ATE cm",
         "ATE cm, as returned", "RPE cm / deg over 1 s", "CPU ms a frame")
    )  # fmt: skip
    writer.writerows(cells for row in report["rows"] for cells in _rows_of(row))
    return text.getvalue()


def _summary_of(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the line of a row in the report."""
    finals = [run["final"] for run in row.get("peer", ()) if "final" in run]
    best = min(finals, key=lambda final: (-final["posed"], final["ate_cm"] or np.inf), default=None)
    ours = row.get("ours")
    both = (ours, best)
    return (
        row["name"], row["frames"], f"{row['sensor'].lower()}, {row['alignment']}",
        ", ".join("none" if run is None else str(run["posed"]) for run in both),
        ", ".join("-" if run is None else _fixed(run["ate_cm"]) for run in both),
        ", ".join("-" if run is None else _rpe(run) for run in both),
        "yes" if _is_behind(ours, best) else "",
    )  # fmt: skip


def _is_behind(ours: dict[str, Any] | None, best: dict[str, Any] | None) -> bool:
    """Return whether the peer's best run has more poses than ours, or about as many and a lower error."""
    if ours is None or best is None:
        return ours is None
    is_nearer = best["ate_cm"] is not None and best["ate_cm"] < (ours["ate_cm"] or np.inf)
    has_as_many = best["posed"] >= _MIN_POSES_SHARE * ours["posed"]
    return bool(best["posed"] > ours["posed"] or (has_as_many and is_nearer))


def _pace(speed: float) -> str:
    if speed:
        return f"the peer ran at {speed:g} times real time"
    return "the peer got each frame when all of its threads rested, or after 1 s (3 s in run 1)"


def _rows_of(row: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """Yield the lines of a recording in ``runs.csv``: our run, and each run of the peer."""
    about = (row["name"], row["frames"], f"{row['sensor'].lower()}, {row['alignment']}")
    ours = row.get("ours")
    if ours is None:
        yield (*about, "ours", "", "no such tracker", *[""] * 5)
    else:
        others = {f"ours, {name}": run for name, run in row.get("with_features", {}).items()}
        for who, run in {"ours": ours, **others}.items():
            yield (
                *about, who, 1, run["posed"], _fixed(run["longest_gap_s"]), _fixed(run["ate_cm"]),
                _fixed(run["ate_online_cm"]), f"{_fixed(run['rpe_cm'])} / {_fixed(run['rpe_deg'])}",
                f"{run['robot_ms']:.0f} + {run['server_ms']:.0f}",
            )  # fmt: skip
    for number, run in enumerate(row.get("peer", ()), start=1):
        if "failed" in run:
            yield (*about, "ORB-SLAM3", number, run["failed"].partition(":")[0], *[""] * 5)
            continue
        final, online = run["final"], run["online"]
        yield (
            *about, "ORB-SLAM3", number, f"{final['posed']} ({online['posed']} as returned)",
            _fixed(final["longest_gap_s"]), _fixed(final["ate_cm"]), _fixed(online["ate_cm"]),
            f"{_fixed(final['rpe_cm'])} / {_fixed(final['rpe_deg'])}", _cpu(run),
        )  # fmt: skip


def _cpu(run: dict[str, Any]) -> str:
    """Return the CPU time of the peer for a frame; unknown if it includes the polling of its threads."""
    return f"{run['cpu_ms_a_frame']:.0f}" if "looking_ms_a_frame" in run else "not known"


def _rpe(run: dict[str, Any]) -> str:
    return f"{_fixed(run['rpe_cm'])} / {_fixed(run['rpe_deg'])}"


def _fixed(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


@benchmark()
def run_benchmark(args: Options) -> dict[str, Any]:
    """Run all rows, and write the report into the folder."""
    recordings, python = args.recordings.resolve(), args.python.absolute()
    args = replace(args, recordings=recordings, python=python)
    args.folder.mkdir(parents=True, exist_ok=True)
    load_opencv().setNumThreads(1)
    sys.path.append(str(_EXAMPLES_FOLDER))
    file = args.folder / "comparison.json"
    report: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"experiment": "comparison"}
    known = {(row["name"], row["sensor"]): row for row in report.get("rows", [])}
    if args.part != "peer" or "environment" not in report:
        report["environment"] = environment(PlatformSettings())
    if args.part != "ours":
        report |= {"peer": _about_peer(args), "speed": args.speed}
    for row in ROWS:
        recording = str(args.recordings / row.recording)
        camera: CameraChoice = "stereo" if row.sensor == "STEREO" else "left"
        for drive, own in zip(
            drives_of([recording], row.rates_hz, camera="left", imu=False),
            drives_of([recording], row.rates_hz, camera=camera, imu=False),
            strict=True,
        ):
            key = (drive.name_at_rate, row.sensor)
            if args.only in f"{drive.name_at_rate} {row.sensor}":
                known[key] = {
                    **known.get(key, {}),
                    **_measured(args, row, drive, own, known.get(key, {}).get("peer", [])),
                }
                say(known[key])
            report["rows"] = list(known.values())
            report["load_average_after"] = load_average()
            write_json(file, report)
            (args.folder / "report.md").write_text(report_page(report), encoding="utf-8")
            (args.folder / "runs.csv").write_text(runs_table(report), encoding="utf-8")
    return {"rows": report["rows"]}


def _measured(
    args: Options, row: Row, drive: Dataset, own: Dataset, earlier: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Measure a row, our tracker on *own*; with --more, add the peer's runs to the *earlier* ones."""
    before = earlier if args.more else ()
    measured: dict[str, Any] = {
        "name": drive.name_at_rate, "sensor": row.sensor, "frames": len(drive),
        "alignment": "Sim(3)" if row.sensor == "MONOCULAR" else "SE(3)",
    }  # fmt: skip
    if args.part != "peer":
        measured["ours"] = run_ours(configurations_of([row.ours])[0], own) if row.ours else None
        measured["with_features"] = {
            name.partition(":")[0]: run_ours(configurations_of([name])[0], own) for name in row.features
        }
    if args.part != "ours":
        job = job_of(args.recordings, drive, row.sensor)
        measured["peer"] = [*before, *(run_peer(args, drive, row.sensor, job) for _ in range(args.runs))]
    return measured


def _about_peer(args: Options) -> str:
    """Return the version of the peer and the size of its vocabulary."""
    version = ["-c", "from importlib.metadata import version; print(version('pyorbslam3'))"]
    printed = subprocess.run([str(args.python), *version], capture_output=True, text=True, check=True).stdout
    words = sum(line.split()[1] == "1" for line in args.vocabulary.read_text().split("\n")[1:])
    return f"pyorbslam3 {printed.strip()} with a vocabulary of {words} words, trained on these recordings"
