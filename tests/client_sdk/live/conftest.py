"""Fixtures of the tests of a robot in a live map."""

from __future__ import annotations

import pytest

from tests.kit.fake_live_map import FakeLiveRobot


@pytest.fixture
def robot() -> FakeLiveRobot:
    """A connected robot whose platform is simulated, without a map yet."""
    return FakeLiveRobot()
