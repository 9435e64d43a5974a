"""Feed one recording to ORB-SLAM3, and write its trajectories; runs in the process of ORB-SLAM3, the peer.

The file runs only in the peer's own virtual environment, by its path.  This file imports no code of this
project, and no module of the project imports this file.  A job is a JSON file: ``vocabulary``, ``settings``
(YAML), ``sensor``, ``speed``, ``frames`` (time stamp, image, and depth or right image) and ``out``.  A speed
of 1 plays in real time; with 0, each frame is passed as soon as all threads of the peer are idle, so that a
busy machine does not harm the results.

Writes ``online.txt``, the poses as they were returned, ``final.txt``, those of the largest map at the end,
and ``figures.json``.  Poses are of the left camera; TUM format, seconds.

    ENVIRONMENT/bin/python orbslam3_process.py JOB.json
"""

import json
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pyorbslam3

IDLE_CHECKS = 3  # successive checks that have to find all threads idle before the next frame is passed
MAX_IDLE_WAIT_S = 1.0  # longest wait for idle threads


def run_job(job_path):
    """Feed the frames of the job in the file *job_path* to ORB-SLAM3, and write the files of results."""
    job = json.loads(Path(job_path).read_text())
    out = Path(job["out"])
    sensor = pyorbslam3.Sensor.__members__[job["sensor"]]
    slam = pyorbslam3.Slam(job["vocabulary"], job["settings"], sensor)
    track_ms, poses, late_s, waited_s = [], [], 0.0, 0.0
    load_cpu_s = time.process_time()
    began, first_s = time.monotonic(), job["frames"][0][0]
    for stamp_s, image_path, second_path in job["frames"]:
        image = cv2.imread(image_path, cv2.IMREAD_GRAYSCALE)
        second = None if second_path is None else cv2.imread(second_path, cv2.IMREAD_UNCHANGED)
        if job["speed"]:
            due = began + (stamp_s - first_s) / job["speed"]
            late_s = max(late_s, time.monotonic() - due)
            time.sleep(max(0.0, due - time.monotonic()))
        else:
            looked_s = time.thread_time()
            wait_until_all_rest()
            waited_s += time.thread_time() - looked_s
        asked = time.perf_counter()
        if job["sensor"] == "MONOCULAR":
            result = slam.track_monocular(image, stamp_s)
        elif job["sensor"] == "STEREO":
            result = slam.track_stereo(image, second, stamp_s)
        else:
            result = slam.track_rgbd(image, second.astype(np.float32), stamp_s)
        track_ms.append(1e3 * (time.perf_counter() - asked))
        if result.ok and result.pose_wc is not None:
            poses.append((stamp_s, np.asarray(result.pose_wc)))
    slam.shutdown()
    cpu_s = time.process_time() - load_cpu_s - waited_s
    (out / "online.txt").write_text("".join(line_of(stamp_s, pose) for stamp_s, pose in poses))
    raw = out / "final_ns.txt"
    slam.save_trajectory_euroc(str(raw))
    lines = [line.split() for line in raw.read_text().splitlines()] if raw.exists() else []
    (out / "final.txt").write_text(
        "".join(f"{float(words[0]) / 1e9:.6f} {' '.join(words[1:])}\n" for words in lines if len(words) == 8)
    )
    figures = {
        "frames": len(job["frames"]),
        "online_poses": len(poses),
        "cpu_ms_a_frame": 1e3 * cpu_s / len(job["frames"]),
        "track_ms_p50": float(np.median(track_ms)),
        "track_ms_max": max(track_ms),
        "late_s": late_s,
        "looking_ms_a_frame": 1e3 * waited_s / len(job["frames"]),
    }
    (out / "figures.json").write_text(json.dumps(figures))


def wait_until_all_rest():
    """Wait until no other thread of this process runs or waits for a processor, but at most one second.

    Threads are checked every 4 ms, and have to be idle in three checks in a row.  After one second the
    function returns although threads still run.
    """
    looks, end = 0, time.monotonic() + MAX_IDLE_WAIT_S
    while looks < IDLE_CHECKS and time.monotonic() < end:
        time.sleep(0.004)
        looks = looks + 1 if not any(is_running(task) for task in Path("/proc/self/task").iterdir()) else 0


def is_running(task):
    """Return whether *task* (in /proc/self/task) is another thread that runs or waits for a processor."""
    try:
        state = (task / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state == "R" and int(task.name) != threading.get_native_id()


def line_of(stamp_s, pose):
    """Return a pose as a line of TUM's format."""
    x, y, z = pose[:3, 3]
    w = np.sqrt(max(0.0, 1 + np.trace(pose[:3, :3]))) / 2
    if w > 1e-3:
        r = pose[:3, :3]
        q = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w)
    else:
        axis, _ = cv2.Rodrigues(pose[:3, :3])
        q = (axis / max(np.linalg.norm(axis), 1e-12)).ravel() * np.sqrt(max(0.0, 1 - w * w))
    return f"{stamp_s:.6f} {x:.9f} {y:.9f} {z:.9f} {q[0]:.9f} {q[1]:.9f} {q[2]:.9f} {w:.9f}\n"


if __name__ == "__main__":
    run_job(sys.argv[1])
