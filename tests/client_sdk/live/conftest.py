"""What the tests of a robot in a live map share."""

from __future__ import annotations

import pytest

from tests.client_sdk.live.fake_live_map import FakeLiveRobot


@pytest.fixture
def robot() -> FakeLiveRobot:
    """A robot whose platform is a few lines."""
    return FakeLiveRobot()
