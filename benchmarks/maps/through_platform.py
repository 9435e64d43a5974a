"""Judge merged maps that were made through the platform: rows 1 and 2 of issue 6, the red kitchen at 10 Hz.

Defends: three robots, merged ATE at most 4.5 cm, origins 7 cm / 2.5 deg, cloud 15 mm median and 85 % under
5 cm of the one built with true poses; one robot, loops closed, ATE at most 4.5 cm and never worse than
without.  Runs ``rse-pf demo --merge`` twice (balancer, two servers, data service, robots, the merge as a
job), unless --folders names the folders of earlier runs.  The maps are judged by their files alone.

    python -m benchmarks.maps.through_platform --recordings ../shared/data --out map_platform.json
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.maps.recordings import cloud_of, red_kitchen, truth_of
from benchmarks.maps.services import alignment_of_poses
from client_sdk.datasets import Dataset
from client_sdk.mapping import read_ply, read_trajectory
from rse_pf.geometry import transform

SAMPLE = 50_000


def demo(recordings: Path, robots: int, out: Path) -> None:
    """Run the demo as a user does."""
    command = [
        sys.executable,
        "-m",
        "rse_pf.cli.main",
        "demo",
        "--data",
        str(recordings / "7scenes_redkitchen"),
    ]
    command += ["--rate", "10", "--robots", str(robots), "--merge", "--quiet", "--out", str(out)]
    subprocess.run(command, check=True, stdout=sys.stderr)


def judge(dataset: Dataset, folder: Path, every: int = 5) -> dict[str, Any]:
    """Return the figures of one demo's folder.

    The cloud is judged twice: ``cloud`` is built anew from every *every*-th frame at its merged pose, as the
    benchmark in one process does; ``merged_ply`` is the file that the user gets, whose points have moved with
    their keyframes.  Both are aligned by whole poses.
    """
    import small_gicp

    merged = json.loads((folder / "report.json").read_text(encoding="utf-8"))["merged"]
    paths = [read_trajectory(folder / name / "merged_trajectory.txt") for name in merged["joined"]]
    stamps = np.concatenate([path.timestamps_s for path in paths])
    poses = np.concatenate([path.T_world_camera for path in paths])
    truth = truth_of(dataset, [float(stamp) for stamp in stamps])
    rows = [
        dataset.rows[int(np.argmin(np.abs(np.asarray(dataset.timestamps_s) - stamp)))] for stamp in stamps
    ]
    T_truth_merged = alignment_of_poses(poses, truth)
    true_cloud = cloud_of(dataset, rows[::every], truth[::every]).points()[0]
    tree = small_gicp.KdTree(small_gicp.PointCloud(true_cloud.astype(np.float64)))

    def distances(points: npt.NDArray[np.float32]) -> dict[str, float]:
        chosen = transform(T_truth_merged, points[:: max(1, len(points) // SAMPLE)].astype(np.float64))
        distances_m = np.sqrt(np.asarray(tree.batch_nearest_neighbor_search(chosen)[1]))
        return {
            "median_mm": round(1e3 * float(np.median(distances_m)), 2),
            "under_5_cm_percent": round(100.0 * float((distances_m < 0.05).mean()), 1),
        }

    left_out = ("refused", "map", "points", "frames")
    return {
        **{name: value for name, value in merged.items() if name not in left_out},
        "cloud": distances(cloud_of(dataset, rows[::every], poses[::every]).points()[0]),
        "merged_ply": distances(read_ply(folder / "merged.ply")[0]),
    }


def rows_of(three: dict[str, Any], one: dict[str, Any]) -> list[tuple[str, str, str, bool]]:
    """Return the issue's rows: what, bar, measured, met."""
    worst_cm = max(origin["cm"] for origin in three["origins"])
    worst_deg = max(origin["deg"] for origin in three["origins"])
    cloud, ply = three["cloud"], three["merged_ply"]
    rows = [
        ("joined", "3 robots", str(len(three["joined"])), len(three["joined"]) == 3),
        ("merged ATE", "4.5 cm", f"{three['ate_cm']:.2f} cm", three["ate_cm"] <= 4.5),
        (
            "origins",
            "7 cm, 2.5 deg",
            f"{worst_cm:.1f} cm, {worst_deg:.2f} deg",
            worst_cm <= 7 and worst_deg <= 2.5,
        ),
    ]
    for name, figures in (("cloud of the frames", cloud), ("merged.ply", ply)):
        text = f"{figures['median_mm']:.1f} mm, {figures['under_5_cm_percent']:.0f} %"
        met = figures["median_mm"] <= 15 and figures["under_5_cm_percent"] >= 85
        rows.append((name, "15 mm median, 85 % under 5 cm", text, met))
    text = f"{one['ate_cm']:.2f} cm, without {one['ate_before_cm']:.2f} cm"
    met = one["ate_cm"] <= min(4.5, one["ate_before_cm"])
    return [*rows, ("one robot, loops closed", "4.5 cm, not worse than without", text, met)]


def main() -> int:
    """Run or read, judge, and print the table; the exit code is 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--recordings", type=Path, required=True, help="the folder of recordings")
    parser.add_argument("--folders", type=Path, nargs=2, metavar=("THREE", "ONE"), help="judge these demos")
    parser.add_argument("--out", type=Path, help="write the figures here as JSON")
    arguments = parser.parse_args()
    dataset = red_kitchen(arguments.recordings)
    before = os.getloadavg()
    with tempfile.TemporaryDirectory() as temporary:
        folders = arguments.folders or [Path(temporary) / "three", Path(temporary) / "one"]
        if arguments.folders is None:
            for robots, folder in zip((3, 1), folders, strict=True):
                demo(arguments.recordings, robots, folder)
        three, one = (judge(dataset, folder) for folder in folders)
    rows = rows_of(three, one)
    print("| what | bar | measured | |\n|---|---|---|---|")
    for what, bar, measured, met in rows:
        print(f"| {what} | {bar} | {measured} | {'met' if met else 'MISSED'} |")
    print(f"load average before {before[0]:.1f}, after {os.getloadavg()[0]:.1f}")
    if arguments.out:
        figures = {"three": three, "one": one, "load": before, "load_after": os.getloadavg()}
        arguments.out.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0 if all(row[3] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
