"""Programs that a test of ROS starts: their lines are kept, and they are ended with their group."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from client_sdk import connect
from client_sdk.bags import BagOptions, open_bag
from rse_pf.local.control.platform import LocalPlatform

__all__ = ["Line", "Program", "RosPrograms", "own_run", "poses", "tell_delay", "worst_mm"]


class Line(TypedDict, total=False):
    """A line of the listener."""

    kind: str
    stamp: int
    at: float
    frame: str
    child: str
    position: list[float]
    values: dict[str, str]
    ok: bool
    message: str


class Program:
    """A process whose lines are kept; it is ended with its group."""

    def __init__(self, words: list[str], env: dict[str, str]) -> None:
        self.lines: list[str] = []
        self._changed = threading.Condition()
        self.process = subprocess.Popen(
            words,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line)
                self._changed.notify_all()

    def until(self, enough: Callable[[list[str]], bool], timeout_s: float = 60) -> None:
        """Wait for lines; fail with all of them after *timeout_s*."""
        with self._changed:
            assert self._changed.wait_for(lambda: enough(self.lines), timeout_s), "".join(self.lines[-20:])

    def heard(self, kind: str) -> list[Line]:
        """Return the lines of a kind that a listener wrote."""
        found: list[Line] = [json.loads(line) for line in list(self.lines) if line.startswith("{")]
        return [line for line in found if line["kind"] == kind]

    def end(self, number: int = signal.SIGINT) -> int:
        """End the process, and return its exit code."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)
            try:
                self.process.wait(15)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
        code = self.process.wait(15)
        self._reader.join(15)
        if self.process.stdout is not None and not self._reader.is_alive():
            self.process.stdout.close()
        return code


class RosPrograms:
    """Programs with the environment of one ROS; `end` ends all of them."""

    shell = "ros1"
    listener_file = "ros1_listener.py"

    def __init__(self, python: str, topics: dict[str, str], env: dict[str, str]) -> None:
        """Describe them: the Python that has this ROS, the topics of a bridge, and the environment."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS", "RMW"))}
        self.python, self._topics = python, topics
        self._env = {**kept, "PYTHONPATH": str(Path(__file__).parents[2]), **env}
        self._stack = contextlib.ExitStack()

    def start(self, *words: str) -> Program:
        program = Program(list(words), self._env)
        self._stack.callback(program.end, signal.SIGTERM)
        return program

    def listener(self, *words: str) -> Program:
        program = self.start(self.python, str(Path(__file__).with_name(self.listener_file)), *words)
        program.until(lambda lines: any('"ready"' in line for line in lines))
        return program

    def bridge(self, url: str, token_file: Path, shell: str = "", **options: str) -> Program:
        # rospy is not in the environment of the tests, but the bridge takes it from Debian; rclpy is not.
        python = self.python if (shell or self.shell) == "ros2" else sys.executable
        words = [f"--{name.replace('_', '-')}={value}" for name, value in {**self._topics, **options}.items()]
        program = self.start(
            python, "-m", "ros_bridge", shell or self.shell, "--url", url, "--token-file", str(token_file),
            "--queue-frames=100", *words,
        )  # fmt: skip
        program.until(lambda lines: any(line.startswith("bridging") for line in lines))
        return program

    def end(self) -> None:
        self._stack.close()


async def own_run(
    bag: Path, platform: LocalPlatform, options: BagOptions | None = None, out: Path | None = None
) -> dict[int, np.ndarray[Any, Any]]:
    """Return the positions that the SDK alone gives for a bag, as they come, by stamps in milliseconds.

    Its map is written into the folder *out*, as `rse-pf map from-bag` does.
    """
    found = {}
    with open_bag(bag, options or BagOptions()) as opened:
        async with connect(platform.url, token=platform.issue_token("sdk")) as robot:
            mapper = robot.mapper()
            for frame in opened:
                pose = (await mapper.track(frame)).T_world_camera
                if pose is not None:
                    found[round(1e3 * frame.timestamp_s)] = pose[:3, 3]
            if out is not None:
                mapper.save(out)
    return found


def poses(number: int, kind: str = "pose") -> Callable[[list[str]], bool]:
    """Return a function that returns whether a listener has written *number* poses, or lines of *kind*."""
    return lambda lines: sum(f'"kind": "{kind}"' in line for line in lines) >= number


def worst_mm(heard: list[Line], expected: dict[int, np.ndarray[Any, Any]]) -> float:
    """Return the largest distance from the SDK's own poses of the same time stamps, millimetres."""
    by_ms = {round(line["stamp"] / 1e6): line["position"] for line in heard}
    assert by_ms.keys() == expected.keys()
    return 1e3 * max(float(np.linalg.norm(np.array(by_ms[ms]) - expected[ms])) for ms in expected)


def tell_delay(listener: Program) -> None:
    """Print how long after its image a pose came, and how long the mapper needed of that."""
    came = {line["stamp"]: line["at"] for line in listener.heard("image")}
    delays = [1e3 * (line["at"] - came[line["stamp"]]) for line in listener.heard("pose")]
    tracking = listener.heard("status")[-1]["values"]["track ms (median)"]
    print(f"image to pose: median {np.median(delays):.1f} ms, of which the mapper took {tracking} ms")
