"""The example of a recording in a live map, on a robot that loses its connection: what waits is told."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib.util
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from client_sdk.live import LiveMapper, LiveOptions
from tests.kit.example_page import REPOSITORY
from tests.kit.fake_live_map import FakeLiveRobot, solve
from tests.kit.flat_world import CAMERA, frame_at

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load the program; it works in *tmp_path*."""
    path = REPOSITORY / "examples" / "robots" / "live_map_recording.py"
    spec = importlib.util.spec_from_file_location("live_map_recording", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    return module


class RobotWithLiveMaps(FakeLiveRobot):
    """A robot with live maps of its own making, as `client_sdk.Robot`."""

    def live_map(self, name: str, spool: Path) -> LiveMapper:
        quick = LiveOptions(leave_s=0.2, bytes_per_s=1e9, relocalise_s=0.001)
        return LiveMapper(self, name, ask=solve, camera=CAMERA, spool=spool, live=quick)


class Recording:
    """Frames, during which the robot loses its connection after the first ones if it is told to."""

    def __init__(self, robot: RobotWithLiveMaps, is_cut: bool) -> None:
        self._robot, self._is_cut = robot, is_cut

    def thinned(self, rate: float) -> Iterator[Any]:
        for row in range(14):
            if row == 2 and self._is_cut:
                self._robot.connected = False
            yield frame_at(row, depth=True)


def drive(example: ModuleType, monkeypatch: pytest.MonkeyPatch, *, is_cut: bool) -> str | None:
    robot = RobotWithLiveMaps()

    @contextlib.asynccontextmanager
    async def connect(**options: Any) -> AsyncIterator[RobotWithLiveMaps]:
        yield robot

    monkeypatch.setattr(example, "connect", connect)
    monkeypatch.setattr(example, "open_dataset", lambda folder: Recording(robot, is_cut))
    args = argparse.Namespace(enrolment="robots/robot-7.enrolment", recording="drive", map="lab", rate=10.0)
    ended: str | None = asyncio.run(example.main(args))
    return ended


def test_a_drive_that_ends_with_keyframes_waiting_says_how_many_and_fails(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ended = drive(example, monkeypatch, is_cut=True)

    waiting = len(list((tmp_path / "keyframes" / "robot-7" / "lab").glob("*.keyframe")))
    assert waiting >= 2
    assert ended == f"{waiting} keyframes wait in keyframes/robot-7, 0 are lost"


def test_a_drive_of_which_the_map_has_every_keyframe_ends_well(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert drive(example, monkeypatch, is_cut=False) is None
