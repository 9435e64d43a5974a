"""What the tests of ROS 2 share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.kit.ros2 import ROS2, Ros2


@pytest.fixture
def ros2(tmp_path: Path) -> Iterator[Ros2]:
    if not (ROS2 / "installed").exists():
        pytest.skip("no ROS 2 in build/ros2: make ros")
    world = Ros2(tmp_path / "ros")
    yield world
    world.end()
